"""Which of several trained Gaussians is used, and which nerfstudio run they belong to."""

import os
import time

import pytest

from hilsplat.scene.layouts import dataparser_of, trained_gaussians

DATAPARSER = "dataparser_transforms.json"


def write(folder, *names, at="2026-01-01_000000"):
    """Write files that were last changed at a local time."""
    changed = time.mktime(time.strptime(at, "%Y-%m-%d_%H%M%S"))
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"ply\n")
        os.utime(path, (changed, changed))


def found(folder):
    return [path.relative_to(folder).as_posix() for path in trained_gaussians(folder)]


def iteration(model, name):
    return f"{model}point_cloud/iteration_{name}/point_cloud.ply"


@pytest.mark.parametrize("model", ["output/a/", "output/", "a/", ""])
def test_most_steps_are_first_and_names_without_a_number_last(tmp_path, model):
    names = ("best", "7000", "30000", "30000_old", "30000 (copy)", "", "100000")
    write(tmp_path, *(iteration(model, name) for name in names))
    order = found(tmp_path)
    assert order[:3] == [iteration(model, name) for name in ("100000", "30000", "7000")]
    assert len(order) == len(names)


@pytest.mark.parametrize(
    "files",  # the first is preferred
    [
        [(iteration("output/x/", "best"), "01-01"), ("exports/splat/splat.ply", "01-01")],
        [
            (iteration("output/c/", "30000"), "01-03"),
            (iteration("output/b/", "30000"), "01-02"),
            (iteration("output/a/", "30000"), "01-01"),
            (iteration("output/d/", "7000"), "01-05"),
        ],
        [("exports/b/splat.ply", "01-09"), ("exports/a/splat.ply", "01-01")],
        [("exports/a/splat.ply", "01-09"), ("exports/b/splat.ply", "01-01")],
        # The time in the name precedes that of the copy.
        [("exports/2026-04-01_120000/splat.ply", "05-01"), ("exports/2026-03-01_120000/splat.ply", "05-02")],
    ],
)
def test_3dgs_is_before_exports_and_of_equals_the_newest_is_first(tmp_path, files):
    for name, day in files:
        write(tmp_path, name, at=f"2026-{day}_120000")
    assert found(tmp_path) == [name for name, _ in files]


def test_links_and_folders_of_that_name_are_passed_over(tmp_path):
    (tmp_path / iteration("output/a/", "9")).mkdir(parents=True)
    (tmp_path / "exports/b").mkdir(parents=True)
    (tmp_path / "exports/b/splat.ply").symlink_to(tmp_path / "gone.ply")
    assert found(tmp_path) == []


def runs(folder, *names):
    write(folder, *(f"outputs/{name}/{DATAPARSER}" for name in names), at="2026-06-01_000000")


def run_of(folder, ply="exports/splat/splat.ply"):
    chosen = dataparser_of(folder / ply, folder)
    return None if chosen is None else chosen.parent.relative_to(folder).as_posix().removeprefix("outputs/")


@pytest.mark.parametrize("experiments", ["ab", "ba"])
@pytest.mark.parametrize("methods", [("splatfacto", "splatfacto-big"), ("splatfacto-big", "splatfacto")])
def test_the_latest_run_counts_whatever_its_experiment_is_called(tmp_path, experiments, methods):
    old = f"{experiments[0]}/{methods[0]}/2025-12-31_235959"
    new = f"{experiments[1]}/{methods[1]}/2026-01-02_080000"
    runs(tmp_path, old, new)
    write(tmp_path, "exports/splat/splat.ply", at="2026-01-02_090000")
    assert run_of(tmp_path) == new


def test_a_ply_belongs_to_the_latest_run_that_began_before_it(tmp_path):
    first, second = "a/splatfacto/2026-01-01_120000", "a/splatfacto/2026-02-01_120000"
    runs(tmp_path, first, second)
    for at, expected in (
        ("2026-01-01_130000", first),
        ("2026-02-01_115959", first),
        ("2026-02-01_123000", second),
        ("2025-01-01_000000", second),  # the time of a copy
    ):
        write(tmp_path, "exports/splat/splat.ply", at=at)
        assert run_of(tmp_path) == expected


def test_a_run_is_named_by_the_folder_around_its_export(tmp_path):
    first, second = "a/splatfacto/2026-01-01_120000", "a/splatfacto/2026-02-01_120000"
    runs(tmp_path, first, second)
    for ply in (
        f"outputs/{first}/splat.ply",
        f"outputs/{first}/exports/splat.ply",
        "exports/2026-01-01_120000/splat.ply",
    ):
        write(tmp_path, ply, at="2026-03-01_000000")
        assert run_of(tmp_path, ply) == first
    write(tmp_path, iteration("output/a/", "30000"))
    assert run_of(tmp_path, iteration("output/a/", "30000")) is None
    assert run_of(tmp_path, "exports/gone/splat.ply") == second
