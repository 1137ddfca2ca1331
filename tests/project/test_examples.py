# SPDX-License-Identifier: MIT
"""The examples do what they say, against a real server: in Python, and in C++ where a compiler is."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_processes import DEADLINE, environment, server
from repository import ROOT
from thin_obstacles import POSTS, views

from tsfusion import Client, Keyframe, Volume, open_dataset
from tsfusion.geometry.trajectory import quaternion
from tsfusion.wire.asking.queries import fetch_mesh, fetch_status
from tsfusion.wire.sockets import sockets

COUNT = 3


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with server(tmp_path_factory.mktemp("examples") / "state") as (found, _):
        yield found


def example(name: str, address: str, folder: Path, *words: object) -> str:
    """Output of an example; it is run in a folder of its own."""
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / name, address, *map(str, words)],
        cwd=folder, env=environment(), text=True, check=False, capture_output=True, timeout=DEADLINE,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def answered(address: str, folder: Path, *words: object) -> str:
    """Output of the planner; on a loaded machine half a second is too short now and then."""
    for _ in range(20):
        try:
            return example("planner.py", address, folder, *words)
        except AssertionError as error:
            if "did not answer in time" not in str(error):
                raise
    raise AssertionError("the map never answered in time")


def test_poses_of_an_own_slam_and_a_planner_that_asks(address: str, tmp_path: Path) -> None:
    assert example("own_slam.py", address, tmp_path) == "8 keyframes are in the map\n"
    said = answered(address, tmp_path)
    distance, x, y, z = map(float, re.findall(r"(-?\d+\.\d+)(?: m from|,|\])", said)[:4])
    assert "stop before it" in said
    assert distance < 0.15
    volume = Volume(voxel_size=0.02)
    for keyframe in open_dataset("synthetic:room", count=8):
        volume.integrate(keyframe)
    box = (-1.65, 0.25, 0.7, 1.65, 0.55, 1.0)
    expected = volume.distance_field(box, max_distance=0.3).at(np.array([[x, y, z]]))[0]
    assert abs(distance - expected) < 0.02  # printed to a centimetre
    assert "of a map of 8 keyframes" in said


@pytest.mark.nightly  # else the same scene in tests/tsdf/test_thin_obstacles.py
def test_the_planner_stops_at_a_wall_a_post_and_what_is_unseen(tmp_path: Path) -> None:
    how = ("--voxel-size", 0.04, "--sensor", "tof", "--space-carving")
    with server(tmp_path / "state", *how) as (address, _):
        with Client(address) as client:
            for view in views(1.0, color=True):
                client.send(view)
            client.wait_settled(DEADLINE)
        wall, post = POSTS[0][0] + 1.0, POSTS[2]
        free = answered(address, tmp_path, wall - 0.6, -0.3, 1.1, wall - 0.6, 0.3, 1.1)
        along = answered(address, tmp_path, wall - 0.1, -0.3, 1.1, wall - 0.1, 0.3, 1.1)
        through = answered(address, tmp_path, 2.5, post[1], 1.1, 3.5, post[1], 1.1)
        unseen = answered(address, tmp_path, wall + 0.4, -0.3, 1.1, wall + 0.4, 0.3, 1.1)
    assert "the path keeps 0.2" in free or "the path keeps 0.3" in free
    assert re.match(r"0\.(0[6-9]|1[0-4]) m from a surface", along)
    place = re.search(r"at \[(.*?),.*stop before it", through)
    assert place is not None
    assert abs(float(place[1]) - (post[0] - 0.15)) < 0.08
    assert unseen.startswith("0.00 m from a surface, or 0 as unseen")


@pytest.mark.nightly  # else two scanners in tests/end_to_end/test_several_maps.py
def test_two_robots_fill_one_map(address: str, tmp_path: Path) -> None:
    hashes = re.findall(r"[0-9a-f]{32}", example("two_robots.py", address, tmp_path))
    assert len(hashes) == 2
    assert len(set(hashes)) == 1


NOTEBOOK = """
import ast, json, sys

def shown(source, names):
    *body, last = ast.parse(source).body
    if not isinstance(last, ast.Expr):
        body, last = [*body, last], None
    exec(compile(ast.Module(body, []), "cell", "exec"), names)
    value = None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return value._repr_html_() if hasattr(value, "_repr_html_") else ""

names = {"__name__": "__main__"}
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        print("shown", shown("".join(cell["source"]), names).count("data:image/png"))
"""


def test_the_notebook_runs_and_shows_pictures(tmp_path: Path) -> None:
    path = ROOT / "examples" / "first_map.ipynb"
    done = subprocess.run(
        [sys.executable, "-c", NOTEBOOK, path], cwd=tmp_path, env=environment(), text=True, check=False,
        capture_output=True, timeout=DEADLINE,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.findall(r"shown (\d)", done.stdout) == ["2", "2", "1", "1", "0", "0"]
    distance = re.search(r"(\d\.\d+) m to the nearest surface", done.stdout)
    assert distance is not None
    assert 0.1 < float(distance[1]) < 2.0
    assert "<Volume: 15 keyframes" in done.stdout
    assert (tmp_path / "room.ply").exists()


def test_the_notebook_is_one_for_every_reader() -> None:
    book = json.loads((ROOT / "examples" / "first_map.ipynb").read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in book["cells"]}) == len(book["cells"])
    for cell in book["cells"]:
        extra = {"outputs", "execution_count"} if cell["cell_type"] == "code" else set()
        assert set(cell) == {"cell_type", "id", "metadata", "source"} | extra
        assert not cell.get("outputs")


@pytest.fixture(scope="module")
def sender(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("sender", tmp_path_factory.mktemp("cpp"))


def built(name: str, folder: Path) -> Path:
    """A program in C++, built as its first lines say."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ is installed: apt-get install g++")
    found, source = folder / name, ROOT / "examples" / "cpp" / f"{name}.cpp"
    line = re.search(r"^//     (g\+\+ .*)$", source.read_text(encoding="utf-8"), re.MULTILINE)
    assert line is not None
    words = [{name: str(found)}.get(word, word) for word in line[1].split()[1:]]
    done = subprocess.run(
        [compiler, "-Wall", "-Wextra", "-Werror", *words], cwd=ROOT, capture_output=True, text=True,
        check=False, timeout=DEADLINE,
    )  # fmt: skip
    if lacking := re.search(r"fatal error: (\S+): No such file|cannot find (-l\w+)", done.stderr):
        pytest.skip(f"{lacking[1] or lacking[2]}: apt-get install libzmq3-dev libmsgpack-cxx-dev libzstd-dev")
    assert done.returncode == 0, done.stderr
    return found


def written(folder: Path, keyframes: list[Keyframe]) -> Path:
    """Keyframes as the sender reads them: PGM files, and a list of them with their poses."""
    lines = []
    for number, keyframe in enumerate(keyframes):
        height, width = keyframe.shape
        head = f"P5\n{width} {height}\n65535\n".encode()
        path = folder / f"{number}.pgm"
        path.write_bytes(head + np.asarray(keyframe.measurement).astype(">u2").tobytes())
        T = keyframe.T_world_camera
        lines.append(" ".join([str(path), *(repr(float(x)) for x in (*T[:3, 3], *quaternion(T[:3, :3])))]))
    (folder / "frames.txt").write_text("\n".join(lines) + "\n")
    return folder / "frames.txt"


def sent(sender: Path, address: str, frames: Path) -> "subprocess.CompletedProcess[str]":
    host, port = address.removeprefix("tcp://").split(":")
    return subprocess.run(
        [sender, host, port, frames, "292.5", "292.5", "159.5", "119.5"], capture_output=True, text=True,
        check=False, timeout=DEADLINE,
    )  # fmt: skip


def test_a_sender_in_cpp_makes_the_same_map(sender: Path, tmp_path: Path) -> None:
    """Every keyframe once, and its integers: the hash is that of the same pixels fused in this process."""
    keyframes = [
        Keyframe(
            depth=(np.asarray(one.measurement) // 10).astype(np.uint16),  # millimetres
            intrinsics=one.intrinsics,
            T_world_camera=one.T_world_camera,
        )
        for one in open_dataset("synthetic:room", count=COUNT)
    ]
    with server(tmp_path / "state") as (address, _):
        done = sent(sender, address, written(tmp_path, keyframes))
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout == f"{COUNT} keyframes are on the server's disk\n"
        status = fetch_status(address, timeout=DEADLINE)
        assert (status.keyframes_durable, status.messages_refused) == (COUNT, {})
    expected = Volume(voxel_size=0.02)
    for keyframe in keyframes:
        expected.integrate(keyframe)
    saved = Volume.load(tmp_path / "state" / "maps" / "default" / "map.tsf")
    assert saved.map_hash() == expected.map_hash()


def test_a_viewer_in_cpp_has_all_triangles(tmp_path: Path) -> None:
    viewer = built("viewer", tmp_path)
    with server(tmp_path / "state") as (address, _):
        with Client(address) as client:
            for keyframe in open_dataset("synthetic:room", count=COUNT):
                client.send(keyframe)
            client.wait_settled(DEADLINE)
        expected = len(fetch_mesh(address, timeout=DEADLINE).faces)
        command = [viewer, sockets.control_address(address), "60"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watching:
            assert watching.stdout is not None
            try:
                counts = (int(line.split()[0]) for line in watching.stdout)
                assert any(abs(count - expected) < 0.001 * expected for count in counts)
            finally:
                watching.kill()


def test_a_sender_in_cpp_says_what_is_wrong(sender: Path, tmp_path: Path) -> None:
    (tmp_path / "frames.txt").write_text(f"{tmp_path}/none.pgm 0 0 0 0 0 0 1\n")
    done = sent(sender, "tcp://127.0.0.1:1", tmp_path / "frames.txt")
    assert done.returncode == 1
    assert "none.pgm is no binary PGM of 16 bits" in done.stderr
