# SPDX-License-Identifier: MIT
"""`tsfusion ask`: the same of a file and of a live server."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from command_processes import Here, python
from keyframes_and_servers import DEADLINE, VOLUME, Server, serving, wall

from tsfusion import Client, Volume
from tsfusion.core.errors import DatasetError
from tsfusion.geometry.map_answers import View
from tsfusion.geometry.map_questions import MOST_POINTS
from tsfusion.pipelines.maps import answer_files
from tsfusion.pipelines.maps.saved_maps import SavedMapAnswers

POINTS = np.array([[0.0, 0.0, 1.2], [0.1, 0.05, 1.27], [9.0, 9.0, 9.0]])
PATIENT = ("--timeout", "60")  # on a machine with a lot to do
SLICE = ("--slice", "-0.3", "0.3", "--up", "-y", "--box", "-1", "-2", "2", "0")
VIEW = ("--view", *["0", "0", "0", "0", "0", "0", "1"], "--size", "64x48")


@pytest.fixture(scope="module")
def volume() -> Volume:
    found = Volume(VOLUME)
    for i in range(3):
        found.integrate(replace(wall(i), color=None))
    return found


@pytest.fixture(scope="module")
def saved(volume: Volume, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return volume.save(tmp_path_factory.mktemp("saved") / "map.tsf")


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("state")) as running:
        with Client(running.address) as client:
            for i in range(3):
                client.send(replace(wall(i), color=None))
            client.wait_settled(DEADLINE)
        yield running


def test_a_file_and_a_server_answer_alike(
    here: Here, volume: Volume, saved: Path, live: Server, tmp_path: Path
) -> None:
    """Points as a table, as an array, as JSON; a view."""
    np.save(tmp_path / "points.npy", POINTS)
    expected = volume.sample(POINTS, surface="raw")
    for name, *source in (("file", str(saved)), ("live", live.address, *PATIENT)):
        table = here("ask", *source, "--points", tmp_path / "points.npy")
        assert table.returncode == 0, table.stderr
        rows = np.loadtxt(table.stdout.splitlines(), delimiter=",", skiprows=1)
        assert table.stdout.splitlines()[0] == ",".join(answer_files.COLUMNS)
        np.testing.assert_array_equal(rows[:, :3], POINTS)
        np.testing.assert_allclose(rows[:, 3], expected.distance, atol=1e-6)
        assert "3 points, of which the map has seen 2" in table.stderr
        done = here("ask", *source, tmp_path / f"{name}.npz", "--points", tmp_path / "points.npy", "--json")
        assert json.loads(done.stdout)["states"][0]["keyframes"] == 3
        sliced = here("ask", *source, tmp_path / f"{name}-slice.npz", "--distances", *SLICE)
        assert sliced.returncode == 0, sliced.stderr
        view = here("ask", *source, tmp_path / f"{name}-view.npz", *VIEW)
        assert view.returncode == 0, view.stderr
        assert "64×48 pixels, the surface in" in view.stdout
    for suffix in (".npz", "-view.npz", "-slice.npz"):
        file, live_too = (tmp_path / f"{name}{suffix}" for name in ("file", "live"))
        with np.load(file) as one, np.load(live_too) as other:
            assert set(one) == set(other)
            for key in one:
                np.testing.assert_allclose(one[key], other[key], atol=1e-6)


def test_a_slice_for_map_server(here: Here, live: Server, tmp_path: Path) -> None:
    done = here("ask", live.address, *PATIENT, tmp_path / "slice.pgm", *SLICE)
    assert done.returncode == 0, done.stderr
    assert "% occupied" in done.stdout
    assert "free space is known near surfaces alone" not in done.stdout
    assert cv2.imread(str(tmp_path / "slice.pgm")).shape[:2] == (50, 75)
    assert "image: " in (tmp_path / "slice.yaml").read_text()
    shares = json.loads(here("ask", live.address, *PATIENT, tmp_path / "slice.png", *SLICE, "--json").stdout)
    assert shares["free"] + shares["occupied"] + shares["unseen"] == pytest.approx(1)
    for flags in ([], ["--unseen-is-free"]):
        done = here("ask", live.address, *PATIENT, tmp_path / "far.npz", *SLICE, "--distances", *flags)
        assert "horizontal distances up to 2 m" in done.stdout
        with np.load(tmp_path / "far.npz") as found:
            unseen = found["distance"][found["cells"] == -1]
            assert len(unseen)
            assert (unseen > 0).all() if flags else (unseen == 0).all()
    done = here("ask", live.address, *PATIENT, tmp_path / "no.png", "--slice", "0", "1")
    assert (done.returncode, "--up" in done.stderr) == (1, True)


def test_one_point_in_words_and_for_a_program(here: Here, live: Server) -> None:
    words = here("ask", live.address, *PATIENT, "--at", "0", "0", "1.2").stdout
    assert " m in front of the surface" in words or " m behind the surface" in words
    assert "a map of 3 keyframes, answered in" in words
    away = here("ask", live.address, *PATIENT, "--at", "-9", "9", "9").stdout
    assert "-9 9 9: unseen, or farther from a surface than that: not known to be free" in away
    assert "distances as fused, known up to 0.12 m before a surface" in away
    answer = json.loads(here("ask", live.address, *PATIENT, "--at", "-9", "9", "9", "--json").stdout)
    assert answer["samples"] == [{"point": [-9, 9, 9], "distance": None, "weight": 0, "gradient": None}]
    assert (answer["distances"], round(answer["reach_m"], 3)) == ("as fused", 0.12)
    assert answer["delay_ms"] > 0


def test_many_points_are_asked_in_parts(here: Here, live: Server, tmp_path: Path) -> None:
    many = np.repeat(POINTS, MOST_POINTS // 2, axis=0)
    np.save(tmp_path / "many.npy", many)
    done = here("ask", live.address, *PATIENT, tmp_path / "out.npy", "--points", tmp_path / "many.npy")
    assert done.returncode == 0, done.stderr
    distances = np.load(tmp_path / "out.npy")
    assert distances.shape == (len(many),)
    assert len(np.unique(distances[np.isfinite(distances)])) == 2


def test_a_ply_and_a_table(saved: Path, here: Here, tmp_path: Path) -> None:
    trimesh.PointCloud(POINTS).export(tmp_path / "points.ply")
    text = "x y z\n" + "\n".join(" ".join(map(str, point)) for point in POINTS.tolist()) + "\n"
    (tmp_path / "points.txt").write_text(text)
    one, other = (
        here("ask", saved, "--points", tmp_path / name).stdout for name in ("points.ply", "points.txt")
    )
    assert one.count("\n") == other.count("\n") == 4
    distances = [[line.split(",")[3] for line in text.splitlines()] for text in (one, other)]
    assert distances[0] == distances[1]


def test_a_ply_keeps_vertices_that_are_there_twice(tmp_path: Path) -> None:
    corners = POINTS[[0, 1, 2, 2, 1, 0]]
    trimesh.Trimesh(corners, [[0, 1, 2], [3, 4, 5]], process=False).export(tmp_path / "soup.ply")
    np.testing.assert_allclose(answer_files.read(str(tmp_path / "soup.ply")), corners, atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "id,x,y,z\n7,1,2,3\n8,4,5,6\n", "\ufeff1,2,3\n4,5,6,\n", "# ours\n\nX;Y;Z\n1; 2; 3\n4;5;6",
        '"z" "name" "x" "y"\n3 a 1 2\n6 b 4 5\n', "first\n1, 2, 3, 9\n4\t5\t6\n", "1;2;3;\n;;\n4;5;6;\n,,\n",
    ],
)  # fmt: skip
def test_columns_of_points(tmp_path: Path, text: str) -> None:
    (tmp_path / "points.csv").write_text(text, encoding="utf-8")
    assert answer_files.read(str(tmp_path / "points.csv")).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((), "ask one thing"),
        (("--at", "0", "0", "1", *VIEW), "ask one thing"),
        (("--at", "0", "nan", "1"), "finite"),
        (("--at", "0", "0", "1", "--size", "9x9"), "without --view"),
        (VIEW, "needs a file"),
        (("view.gif", *VIEW), "ending in .png, .npz"),
        (SLICE, "needs a file"),
        (("slice.pgm", "--distances", *SLICE), "ending in .png, .npz"),
        (("slice.png", *SLICE, "--surface", "raw"), "no effect on a slice"),
        (("--at", "0", "0", "1", "--up", "z"), "without --slice"),
        (("slice.png", *SLICE, "--resolution", "0.001"), "resolution"),
        (("view.png", "--view", *["0", "0", "0", "0", "0", "0", "2"]), "length 1"),
        (("view.png", *VIEW[:-1], "big"), "WIDTHxHEIGHT"),
        (("out.doc", "--at", "0", "0", "1"), "ending in .csv"),
        (("--at", "0", "0", "1", "--timeout", "3"), "only a live server"),
        (("--points", "missing.csv"), "No such file"),
    ],
)
def test_wrong_usage_is_one_line(here: Here, saved: Path, arguments: tuple[str, ...], why: str) -> None:
    done = here("ask", saved, *arguments)
    assert done.returncode == 1
    assert why in done.stderr
    assert done.stderr.count("\n") == 1


def test_nobody_there_is_known_in_time(here: Here) -> None:
    done = here("ask", "tcp://127.0.0.1:1", "--at", "0", "0", "1", "--timeout", "0.2")
    assert (done.returncode, done.stdout) == (1, "")
    assert "no server answered" in done.stderr


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1 2 3\n1 2 x\n", ":2: expected x, y, z"),
        ("1,2,x\n", ":1: expected x, y, z"),
        ("1 2\n", ":1: expected x, y, z"),
        ("1,,2,3\n", ":1: expected x, y, z"),
        ("0,5;0,3;1,0\n", ":1: expected x, y, z"),
        ("x,y,z\n", "shape"),
        ("", "shape"),
        ("1 2 inf", "not finite"),
    ],
)
def test_wrong_points_are_named(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(DatasetError, match=why):
        answer_files.read(str(tmp_path / "points.csv"))


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", np.zeros((2, 2))])
def test_wrong_arrays_are_named(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "points.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(DatasetError, match=r"points\.npy"):
        answer_files.read(str(path))


def test_a_picture_shows_colours_or_the_shape(tmp_path: Path) -> None:
    depth = np.array([[0, 1.0]], np.float32)
    normals = np.array([[[0, 0, 0], [0, 0, -1]]], np.float32)
    red = np.array([[[0, 0, 0], [200, 10, 20]]], np.uint8)
    answer_files.write_view(tmp_path / "view.png", View(depth, normals, red))
    assert cv2.imread(str(tmp_path / "view.png")).tolist() == [[[255, 255, 255], [20, 10, 200]]]
    (background, wall_) = answer_files.picture(View(depth, normals))[0].tolist()
    assert background == [255, 255, 255]
    assert len(set(wall_)) == 1
    assert 60 < wall_[0] < 255
    assert answer_files.picture(View(depth))[0].tolist() == [[255, 255, 255], [60, 60, 60]]


def test_a_saved_map_takes_what_a_live_one_takes() -> None:
    asked = SavedMapAnswers(Volume(0.05, threads=2))
    found = asked.raycast((40, 40, 31.5, 23.5), np.eye(4), (4, 6), max_age=0.2, timeout=1.0, normals=False)
    assert found.result.depth.shape == (4, 6)
    assert found.result.normals is None


def test_the_command_needs_no_taichi_for_a_live_map(live: Server) -> None:
    """A robot without it asks by the same verb."""
    done = python(
        "import sys; sys.modules['taichi'] = None; from tsfusion import cli; cli.main(sys.argv[1:])",
        *("ask", live.address, *PATIENT, "--at", "0", "0", "1.2"),
    )
    assert done.returncode == 0, done.stderr
    assert "of the surface" in done.stdout
