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
    assert json.loads(cli.result("validate", made, "--json")) == {
        "file": str(made),
        "valid": True,
        "broken": None,
    }
    damaged = bytearray(made.read_bytes())
    damaged[4096] ^= 0xFF  # the node masks of the root
    (tmp_path / "damaged.octex").write_bytes(damaged)
    (tmp_path / "short.octex").write_bytes(made.read_bytes()[:5000])
    for name in ("damaged.octex", "short.octex"):
        assert cli.run("validate", tmp_path / name) == ExitCode.INVALID
        told, said = cli.said()
        assert (told.count("\n"), said) == (1, "")
        assert name in told
        assert cli.run("validate", tmp_path / name, "--json") == ExitCode.INVALID
        report = json.loads(cli.said()[0])
        assert not report["valid"]
        assert name in report["broken"]
    assert cli.run("validate", tmp_path / "short.octex", "--quiet") == ExitCode.INVALID
    assert cli.said() == ("", "")


def test_a_file_that_cannot_be_read_is_not_a_broken_one(tmp_path, cli):
    for word in ("validate", "info"):
        assert "missing.octex" in cli.refusal(word, tmp_path / "missing.octex")
        assert str(tmp_path) in cli.refusal(word, tmp_path)
