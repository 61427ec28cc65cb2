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


def iterations(model, *names):
    return [f"{model}point_cloud/iteration_{name}/point_cloud.ply" for name in names]


@pytest.mark.parametrize("model", ["output/a/", "output/", "a/", ""])
def test_most_steps_are_first_and_names_without_a_number_last(tmp_path, model):
    names = ("best", "7000", "30000", "30000_old", "30000 (copy)", "", "100000")
    write(tmp_path, *iterations(model, *names))
    order = found(tmp_path)
    assert order[:3] == iterations(model, "100000", "30000", "7000")
    assert sorted(order[3:]) == sorted(iterations(model, "best", "30000_old", "30000 (copy)", ""))


def test_a_name_without_a_number_is_used_if_it_is_the_only_one(tmp_path):
    write(tmp_path, "exports/splat/splat.ply", *iterations("output/x/", "best"))
    assert found(tmp_path) == [*iterations("output/x/", "best"), "exports/splat/splat.ply"]


def test_of_equal_steps_the_newest_is_first(tmp_path):
    for model, day in (("a", 1), ("c", 3), ("b", 2)):
        write(tmp_path, *iterations(f"output/{model}/", "30000"), at=f"2026-01-0{day}_120000")
    write(tmp_path, *iterations("output/d/", "7000"), at="2026-01-05_120000")
    assert found(tmp_path) == [
        *(iterations(f"output/{m}/", "30000")[0] for m in "cba"),
        *iterations("output/d/", "7000"),
    ]


def test_links_and_folders_of_that_name_are_passed_over(tmp_path):
    (tmp_path / iterations("output/a/", "9")[0]).mkdir(parents=True)
    (tmp_path / "exports/b").mkdir(parents=True)
    (tmp_path / "exports/b/splat.ply").symlink_to(tmp_path / "gone.ply")
    assert found(tmp_path) == []


@pytest.mark.parametrize("latest", ["a", "b", "c"])
def test_the_latest_export_is_first(tmp_path, latest):
    for name in "abc":
        day = 9 if name == latest else 1
        write(tmp_path, f"exports/{name}/splat.ply", at=f"2026-01-0{day}_120000")
    assert found(tmp_path)[0] == f"exports/{latest}/splat.ply"
    assert len(found(tmp_path)) == 3


def test_a_timestamp_in_the_name_of_an_export_precedes_that_of_the_copy(tmp_path):
    write(tmp_path, "exports/2026-03-01_120000/splat.ply", at="2026-05-01_120000")
    write(tmp_path, "exports/2026-04-01_120000/splat.ply", at="2026-05-01_110000")
    assert found(tmp_path)[0] == "exports/2026-04-01_120000/splat.ply"


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
    write(tmp_path, *iterations("output/a/", "30000"))
    assert run_of(tmp_path, *iterations("output/a/", "30000")) is None
    assert run_of(tmp_path, "exports/gone/splat.ply") == second
