"""Textures in an S3 store: a stand-in of one answers, moto's server."""

import json

import numpy as np
import pytest

import octex
from octex.errors import TextureFileError
from tests.make.small_textures import shell

pytest.importorskip("s3fs", reason="needs s3fs")
server_of = pytest.importorskip("moto.server", reason="needs moto[server]")


@pytest.fixture
def store(monkeypatch):
    """The address of a store on this machine, which fsspec uses."""
    import fsspec
    import s3fs

    server = server_of.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    settings = {"endpoint_url": f"http://{host}:{port}", "skip_instance_cache": True}
    monkeypatch.setitem(fsspec.config.conf, "s3", settings)
    s3fs.S3FileSystem.clear_instance_cache()
    fsspec.filesystem("s3").mkdir("textures")
    yield "s3://textures/a.octex"
    server.stop()


def test_a_texture_in_a_store_answers_as_here(store, tmp_path):
    import fsspec

    shell(6, keep=0).save(tmp_path / "a.octex")
    content = (tmp_path / "a.octex").read_bytes()
    fsspec.filesystem("s3").pipe(store, content)
    here, there = octex.open(tmp_path / "a.octex"), octex.open(store)
    points = here.placement.origin + here.placement.size * np.random.default_rng(0).random((50, 3))
    views = {"width": here.placement.size / 16, "normals": points - points.mean(axis=0)}
    np.testing.assert_array_equal(there.sample(points, **views), here.sample(points, **views))
    assert there.storage.file._is_fetched.mean() < 0.6
    np.testing.assert_array_equal(there.sample(points), here.sample(points))
    assert json.dumps(there.info()) == json.dumps(here.info())
    there.save(tmp_path / "b.octex")
    assert (tmp_path / "b.octex").read_bytes() == content
    changed = octex.open(store)
    fsspec.filesystem("s3").pipe(store, content[::-1])
    with pytest.raises(TextureFileError, match=r"^s3://textures/a\.octex: changed after it was opened"):
        changed.validate()
    with pytest.raises(TextureFileError, match=r"^s3://textures/none\.octex: .*no such file"):
        octex.open(store.replace("a.octex", "none.octex"))
