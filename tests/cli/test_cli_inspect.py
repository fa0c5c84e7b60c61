"""A look at textures at the command line."""

import json
import re

import octex
from octex.errors import ExitCode


def test_info_is_text_for_people_and_json_for_machines(made, cli):
    texture = octex.open(made)
    assert json.loads(cli.result("info", made, "--json")) == texture.info()
    text = cli.result("info", made)
    assert re.search(r"^depth +4, finest cells of edge [\d.]+$", text, re.MULTILINE)
    assert re.search(rf"^ +all +{texture.tree.n_leaves:,} +{texture.tree.n_nodes:,}$", text, re.MULTILINE)
    assert re.search(r"^channels +base_color  3 x uint8    srgb$", text, re.MULTILINE)
    assert re.search(rf"^total +{made.stat().st_size:,} ", text, re.MULTILINE)
    assert re.search(r"^source +box\.glb$", text, re.MULTILINE)


def test_validate_proves_a_texture_or_names_what_is_broken(made, tmp_path, cli):
    assert cli.result("validate", made) == "valid\n"
    assert cli.result("validate", made, "--quiet") == ""
    assert cli.facts("validate", made) == {"file": str(made), "valid": True, "broken": None}
    damaged = bytearray(made.read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    for name, content in (("damaged.octex", damaged), ("short.octex", made.read_bytes()[:5000])):
        (tmp_path / name).write_bytes(content)
        for words in ([], ["--json"], ["--quiet"]):
            assert cli.run("validate", tmp_path / name, *words) == ExitCode.INVALID
            told, said = cli.said()
            assert (told.count("\n"), said) == (words != ["--quiet"], "")
            if words == ["--json"]:
                assert not json.loads(told)["valid"]
                told = json.loads(told)["broken"]
            assert words == ["--quiet"] or name in told
