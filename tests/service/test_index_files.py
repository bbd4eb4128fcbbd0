"""A large scene, searched by its index file, through a real server."""

from functools import partial
from pathlib import Path
from urllib.request import urlopen

import pytest
from support.servers import CAMERA, PHOTO, make_scene, serving
from support.waiting import wait_until

from mapless import Client, ConnectOptions
from mapless_server.scenes.index_files import IndexFileOptions, IndexFiles
from mapless_server.scenes.retrieval.index_file import Header
from mapless_server.serve import assembly

OPTIONS = IndexFileOptions(least_references=3)


def chosen(client: Client) -> list[str]:
    """References that were chosen for the photograph."""
    return [it.name for it in client.localize(PHOTO, CAMERA, "s").diagnostics.references]


@pytest.mark.parametrize("part", ["rows", "records"])
def test_a_damaged_file_changes_no_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str) -> None:
    monkeypatch.setattr(assembly, "IndexFiles", partial(IndexFiles, options=OPTIONS))
    once = ConnectOptions(max_attempts=1)
    with serving(tmp_path, metrics=True, metrics_port=0) as server, Client(server.address, once) as client:
        make_scene(client, count=3)
        expected = chosen(client)
        assert len(expected) == 3

        def files() -> str:
            with urlopen(f"http://{server.metrics_address}/metrics") as answer:
                metrics = dict(line.rsplit(" ", 1) for line in answer.read().decode().splitlines())
            return f"{metrics['mapless_retrieval_index_files']} {metrics['mapless_retrieval_index_file_bytes']}"

        wait_until(lambda: files().startswith("1.0"))
        (path,) = (tmp_path / "indexes").glob("*.index")
        right = path.read_bytes()
        assert files() == f"1.0 {float(len(right))}"
        assert chosen(client) == expected
        with path.open("r+b") as file:
            at = Header.read(file.fileno()).parts[part].offset
            file.seek(at)
            file.write(bytes([right[at] ^ 1]))
        assert chosen(client) == expected
        wait_until(lambda: chosen(client) == expected and path.exists() and path.read_bytes() == right)
        client.delete_scene("s")
        assert not path.exists()
