"""The client with the oldest and the newest versions of its dependencies, without the server's packages."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.servers import PHOTO, serving

ROOT = Path(__file__).parents[2]
(_LISTED,) = re.findall(
    r"^dependencies = \[\n(.*?)^\]", (ROOT / "pyproject.toml").read_text(), re.MULTILINE | re.DOTALL
)
FLOORS = re.findall(r'"([\w-]+>=[\d.]+)"', _LISTED)

PROGRAM = """
import asyncio, importlib.util, sys
import google.protobuf, grpc, numpy as np
import mapless

assert not [name for name in ("torch", "cv2", "scipy", "PIL") if importlib.util.find_spec(name)]
address, photo = sys.argv[1:]
camera = mapless.Camera(96, 64, 80.0, 81.0, 47.5, 31.5)
poses = [mapless.RigidTransform(np.eye(3), np.array([x, 2.0, -1.0])) for x in (0.0, 1.0)]
references = [mapless.NewReference(f"r{i}", photo, camera, pose) for i, pose in enumerate(poses)]
prior = mapless.Priors(heading=mapless.HeadingPrior(np.array([0.0, 0.0, 1.0]), 10.0))


def check(answer):
    assert isinstance(answer, mapless.LocalizationResult), answer
    assert answer.world_from_camera.translation.tolist() == [0.0, 2.0, -1.0]
    assert answer.covariance.shape == (6, 6)


with mapless.Client(address) as client:
    client.create_scene("blocking")
    client.add_references("blocking", references)
    assert len(list(client.list_references("blocking", page_size=1))) == 2
    check(client.localize(photo, camera, "blocking", priors=prior, axes="ros", include_debug=True))
    try:
        client.localize(b"no photograph", camera, "blocking")
    except mapless.InvalidArgument as error:
        assert (error.field, error.reason[:6]) == ("image", "IMAGE_"), error
    client.delete_scene("blocking")


async def again():
    async with mapless.aio.Client(address) as client:
        await client.create_scene("asyncio")
        await client.add_references("asyncio", references)
        assert [it.reference_id async for it in client.list_references("asyncio", page_size=1)] == ["r0", "r1"]
        check(await client.localize(photo, camera, "asyncio", priors=prior))


asyncio.run(again())
check(mapless.localize(photo, camera, address=address))
print(google.protobuf.__version__, grpc.__version__, np.__version__)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The installed package, built outside the source tree."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("client", "server", "deploy/ray"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    _pip("wheel", "--no-deps", "--wheel-dir", str(built), str(source))
    (made,) = built.glob("*.whl")
    return made


def _pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", *arguments, "--quiet", "--disable-pip-version-check"]
    subprocess.run(command, check=True, timeout=170)


@pytest.mark.nightly
@pytest.mark.parametrize("end", ["floor", "newest"])
def test_the_client_runs_at_both_ends_of_its_versions(end: str, wheel: Path, tmp_path: Path) -> None:
    assert {"protobuf", "grpcio", "numpy"} < {it.partition(">=")[0] for it in FLOORS}
    wanted = [it.replace(">=", "==") if end == "floor" else it for it in FLOORS]
    site, photo = tmp_path / "site", tmp_path / "photo.png"
    photo.write_bytes(PHOTO)
    _pip("install", "--target", str(site), "--no-compile", "--only-binary=:all:", *wanted, str(wheel))

    def run(*arguments: str) -> str:
        # Without -S there would be this environment's packages, too.
        done = subprocess.run(
            [sys.executable, "-S", *arguments],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env={"PYTHONPATH": str(site), "PYTHONWARNINGS": "error::UserWarning:google"},
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    with serving(tmp_path / "data") as server:
        protobuf, grpcio, _ = run("-c", PROGRAM, server.address, str(photo)).split()
        localize = ("localize", "asyncio", str(photo), "--camera", "80,81,47.5,31.5", "--debug")
        assert '"pose_stage": "REFINED"' in run("-m", "mapless", "--address", server.address, *localize)
    if end == "floor":
        assert {f"protobuf=={protobuf}", f"grpcio=={grpcio}"} <= {*wanted}
