# SPDX-License-Identifier: MIT
"""`tsfusion mesh` for sharing: cut, without crumbs, holes closed, thinned, in every format."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import trimesh
from command_processes import Here
from formula_scenes import sphere_views, volume_of

from tsfusion import Volume
from tsfusion.core.errors import InvalidConfig, OutputError
from tsfusion.pipelines.maps import mesh_finishing
from tsfusion.pipelines.maps.mesh_finishing import simplification
from tsfusion.wire.asking import queries


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere that no camera saw all of."""
    return volume_of(sphere_views(0.3, 5)).save(tmp_path_factory.mktemp("map") / "map.tsf")


def figures(here: Here, *words: object) -> dict[str, object]:
    done = here("mesh", *words, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    found = json.loads(done.stdout)
    assert isinstance(found, dict)
    return found


def test_flags_do_what_the_mesh_does(here: Here, saved: Path, tmp_path: Path) -> None:
    mesh = Volume.load(saved, threads=2).extract_mesh(fill_holes=6)
    box = (-0.2, -0.25, -0.4, 0.4, 0.25, 0.1)
    expected = mesh.cropped(box).without_islands(0.1).simplified(ratio=0.4).with_guesses_marked()
    found = figures(
        here, saved, tmp_path / "m.glb", "--crop", *box, "--min-component", 0.1, "--fill-holes", 6,
        "--mark-guesses", "--simplify", "40%",
    )  # fmt: skip
    assert found["triangles"] == len(expected.faces)
    assert found["guessed_triangles"] == int(expected.guessed.sum()) > 0
    assert found["legend"] == [{"color": "#e628be", "name": "guessed: nobody saw this"}]
    assert found["left_out"]["min_extent_m"] == 0.1
    scene = trimesh.load(tmp_path / "m.glb", process=False)
    assert set(scene.geometry) == {"seen", "guessed"}
    assert sum(len(one.faces) for one in scene.geometry.values()) == found["triangles"]


def test_a_file_says_where_its_mesh_comes_from(here: Here, saved: Path, tmp_path: Path) -> None:
    volume = Volume.load(saved, threads=2)
    figures(here, saved, tmp_path / "m.ply")
    head = (tmp_path / "m.ply").read_bytes().partition(b"end_header")[0].decode()
    for line in ("source map.tsf", f"keyframes {volume.keyframes}", f"map_hash {volume.map_hash()}"):
        assert f"comment {line}\n" in head


@pytest.mark.parametrize("suffix", [".stl", ".pcd", ".las", ".laz"])
def test_every_format_is_written(here: Here, saved: Path, tmp_path: Path, suffix: str) -> None:
    figures(here, saved, tmp_path / f"m{suffix}")
    assert (tmp_path / f"m{suffix}").stat().st_size > 10_000


def test_a_person_is_told_what_was_left_out_and_painted(here: Here, saved: Path, tmp_path: Path) -> None:
    done = here("mesh", saved, tmp_path / "m.ply", "--fill-holes", 8, "--mark-guesses")
    assert "guessed" in done.stdout.splitlines()[0]
    assert "  #e628be  guessed: nobody saw this" in done.stdout
    assert "closing holes of" in done.stderr


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--crop", 0, 0, 0, 1, 1, 0], "a box is x0 y0 z0 x1 y1 z1"),
        (["--crop", 8, 8, 8, 9, 9, 9], "nothing of the mesh lies in this box"),
        (["--min-component", 9], "no piece of the mesh is 9 m across"),
        (["--min-component", -1], "0 metres or more"),
        (["--min-component", 1, "--keep-islands"], "leave out --keep-islands"),
        (["--fill-holes", 0], "1 to 64 voxels"),
        (["--mark-guesses"], "--fill-holes"),
        (["--simplify", "lots"], "a share (0.25 or 25%), a number of triangles (50000) or an error (5mm)"),
        (["--simplify", "-5mm"], "a share"),
        (["--simplify", "150%"], "ratio must be"),
    ],
)
def test_flags_that_make_no_sense_are_refused(
    here: Here, saved: Path, tmp_path: Path, flags: list[object], message: str
) -> None:
    done = here("mesh", saved, tmp_path / "m.ply", *flags)
    assert done.returncode != 0
    assert message in " ".join(done.stderr.split())
    assert not list(tmp_path.iterdir())


def test_a_live_map_that_is_behind_is_said_to_be(
    here: Here, saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    behind = SimpleNamespace(waiting=78, corrections_waiting=1)
    health = SimpleNamespace(maps={"yard": behind, "hall": SimpleNamespace(waiting=0, corrections_waiting=0)})
    monkeypatch.setattr(queries, "fetch_health", lambda *_, **__: health)
    monkeypatch.setattr(queries, "fetch_mesh", lambda *_, **__: Volume.load(saved).extract_mesh())
    done = here("mesh", "tcp://127.0.0.1:9", tmp_path / "m.ply", "--map", "yard", "--json")
    assert "78 keyframes and 1 corrected pose wait to be fused" in done.stderr
    assert json.loads(done.stdout)["keyframes_waiting"] == 78
    done = here("mesh", "tcp://127.0.0.1:9", tmp_path / "n.ply", "--map", "hall", "--json")
    assert (done.stderr, json.loads(done.stdout)["keyframes_waiting"]) == ("", 0)


def test_a_live_server_closes_no_holes(here: Here, tmp_path: Path) -> None:
    done = here("mesh", "tcp://127.0.0.1:9", tmp_path / "m.ply", "--fill-holes", 3)
    assert "--fill-holes needs the map: give the state folder of the server" in done.stderr


def test_targets_of_a_simplification() -> None:
    assert simplification(None) is None
    assert simplification("25%") == simplification("0.25") == {"ratio": 0.25}
    assert simplification("50000") == {"triangles": 50000}
    for text, metres in (("5mm", 0.005), ("2cm", 0.02), ("0.1m", 0.1)):
        assert simplification(text) == {"max_error": pytest.approx(metres)}
    for text in ("", "1.5", "0", "nan", "mm", "5 km"):
        with pytest.raises(InvalidConfig):
            simplification(text)


def test_a_box_of_a_map_larger_than_memory_has_the_same_mesh(
    here: Here, saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_finishing, "_MARGIN", 8)
    box, whole = (-0.31, -0.31, 0.2, 0.31, 0.31, 0.33), Volume.load(saved, threads=2)
    memory = ("--memory", whole.stats().bytes - 1)
    found = figures(here, saved, tmp_path / "m.ply", "--crop", *box, *memory, "--surface", "raw")
    expected = whole.extract_mesh(surface="raw").cropped(box)
    assert found["triangles"] == len(expected.faces)
    for flags in (["--simplify", "50%"], ["--fill-holes", "5"]):
        done = here("mesh", saved, tmp_path / "n.ply", *flags, *memory)
        assert (
            f"{flags[0]} needs all of the mesh, which is too large for memory: give a --crop" in done.stderr
        )
    with pytest.raises(OutputError, match="too large for memory, too"):
        mesh_finishing.part_around(whole, (-1, -1, -1, 1, 1, 1), 1000)


def test_a_mesh_larger_than_memory_loses_its_small_pieces(
    here: Here, saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tsfusion.tsdf.surface.field_regularizer.BATCH", 40)
    whole = Volume.load(saved, threads=2)
    memory = ("--memory", whole.stats().bytes - 1)
    mesh = whole.extract_mesh()
    found = figures(here, saved, tmp_path / "m.ply", "--min-component", 0.2, *memory)
    assert found["triangles"] == len(mesh.without_islands(0.2).faces)
    left_out = {**mesh.count_islands(mesh.islands(0.2)), "files": ["m.ply"], "min_extent_m": 0.2}
    assert found["left_out"] == left_out
    head = (tmp_path / "m.ply").read_bytes().partition(b"end_header")[0].decode()
    assert f"comment map_hash {whole.map_hash()}\n" in head


def test_a_step_that_would_outgrow_memory_is_refused() -> None:
    steps = {"fill_holes": False, "simplify": False, "texture": False}
    mesh_finishing.check_memory(10**9, 10**9, **steps)  # without steps the map's own memory counts
    for step, flag in (("simplify", "--simplify"), ("texture", "--texture"), ("fill_holes", "--fill-holes")):
        mesh_finishing.check_memory(10**9, 7 * 10**9, **{**steps, step: True})
        with pytest.raises(InvalidConfig, match=f"{flag} needs all of the mesh.* give a --crop"):
            mesh_finishing.check_memory(10**9, 3 * 10**9, **{**steps, step: True})


def test_a_mesh_that_would_outgrow_memory_is_refused(here: Here, saved: Path, tmp_path: Path) -> None:
    memory = ("--memory", Volume.load(saved, threads=2).stats().bytes)
    done = here("mesh", saved, tmp_path / "a.ply", "--simplify", "50%", *memory)
    assert done.returncode != 0
    assert "--simplify needs all of the mesh" in done.stderr
    assert not (tmp_path / "a.ply").exists()


def test_of_a_map_too_large_for_a_step_the_part_around_the_box_is_taken(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_finishing, "_MARGIN", 4)
    whole = Volume.load(saved, threads=2)
    steps = {"fill_holes": False, "simplify": True, "texture": False}
    box, most = (-0.4, -0.4, 0.0, -0.1, 0.4, 0.4), 3 * whole.stats().bytes
    with pytest.raises(InvalidConfig, match="--simplify needs all of the mesh"):
        mesh_finishing.fitting(whole, None, most, **steps)
    with pytest.raises(InvalidConfig, match="a smaller one"):
        mesh_finishing.fitting(whole, (-9, -9, -9, 9, 9, 9), most, **steps)
    part = mesh_finishing.fitting(whole, box, most, **steps)
    assert part.stats().bytes < whole.stats().bytes
    found, expected = (one.extract_mesh().cropped(box) for one in (part, whole))
    assert len(found.faces) == len(expected.faces) > 1000
    assert mesh_finishing.fitting(whole, box, 4 * whole.stats().bytes, **steps) is whole
