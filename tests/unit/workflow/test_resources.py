"""Resources of jobs: above measured peaks, larger for larger scenes, doubled after a kill."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from hilsplat.scene.layouts import vertex_count
from hilsplat.settings import ContributionsSettings
from hilsplat.stage import PathOut, Registry
from hilsplat.stages import all_stages
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.resources import COSTS, RUNNER_MB, JobResources, Size
from tests.conftest import PROJECT
from tests.unit.artifact_changes import flip_bit
from tests.unit.workflow.plans import Job, plan_of

RECORDS = [
    line.split("\t") for line in (Path(__file__).parent / "peak_memory.tsv").read_text().splitlines()[1:]
]
JOB = Job(scene="0")
VARIANTS = {"theta": {"coverage_tree": {"theta": 0.6}}, "lifted": {"method": {"name": "lifted"}}}


def plan(folder: Path, scenes: int = 1, **config: object) -> Plan:
    rows = (f"synthetic {number} benchmark world:tabletop:{number} metre" for number in range(scenes))
    return plan_of(folder, tuple(rows), variants=VARIANTS, **config)


@pytest.mark.parametrize(("rule", "views", "view_mp", "gaussians", "peak_mb"), RECORDS)
def test_requested_memory_exceeds_every_measured_peak(
    tmp_path, monkeypatch, rule, views, view_mp, gaussians, peak_mb
):
    found = JobResources(plan(tmp_path))
    monkeypatch.setattr(found, "size", lambda row: Size(int(views), float(view_mp)))
    monkeypatch.setattr(found, "gaussians", lambda row: int(gaussians))
    job = JOB if int(views) else SimpleNamespace(table="lerf")
    asked = found.memory_mb(rule)(job, threads=2, attempt=1) - RUNNER_MB
    assert 1.1 * float(peak_mb) <= asked
    assert asked <= 6 * float(peak_mb) + 1000  # a node has room for others


def test_the_resources_of_every_rule_are_planned_without_slow_libraries(tmp_path):
    code = f"""
import sys
from pathlib import Path
from tests.unit.workflow.test_resources import COSTS, JOB, JobResources, plan
found = JobResources(plan(Path({str(tmp_path)!r})))
for rule in COSTS:
    print(found.memory_mb(rule)(JOB, 2, 1), found.minutes(rule)(JOB, 2, 1), found.disk_mb(rule, JOB))
print([name for name in ("scipy", "numba", "torch", "cv2", "pandas", "matplotlib") if name in sys.modules])
"""
    how = {"capture_output": True, "text": True, "check": True, "cwd": PROJECT}
    done = subprocess.run([sys.executable, "-c", code], **how)
    assert done.stdout.splitlines()[-1] == "[]"


def test_copies_of_photographs_and_files_of_poses_are_no_views(tmp_path):
    folder = tmp_path / "desk"
    for name in ("images", "images_2", "images_4"):
        (folder / name).mkdir(parents=True)
        for number in range(5):
            Image.new("RGB", (200, 100)).save(folder / name / f"{number}.png")
    (folder / "transforms.json").write_text('{"frames": []}')
    scene = plan_of(tmp_path, ("photos desk photos desk arbitrary",), groups=["photos"])
    assert JobResources(scene).size(scene.scenes[0]) == (5, 0.02)


def test_a_retry_requests_twice_as_much(tmp_path):
    found = JobResources(plan(tmp_path))
    for rule in COSTS:
        for of in (found.memory_mb(rule), found.minutes(rule)):
            first = of(JOB, threads=1, attempt=1)
            assert [of(JOB, threads=1, attempt=n) for n in (2, 3)] == [2 * first, 4 * first]


def test_memory_and_minutes_grow_with_the_work(tmp_path):
    small = JobResources(plan(tmp_path))
    # 400 views of 1024 px: 419 megapixels
    large = JobResources(
        plan(tmp_path, world={"views": 400, "image_px": 1024}, gaussians={"max_gaussians": 1_000_000})
    )
    for rule in ("contributions", "semantic_tree", "field", "gaussians", "poses", "evaluate"):
        for name in ("memory_mb", "minutes"):
            less, more = (getattr(each, name)(rule)(JOB, 1, 1) for each in (small, large))
            assert more > less, (rule, name)


def test_threads_grow_with_the_pixels_of_a_scene(tmp_path):
    scene = plan(tmp_path, world={"views": 40, "image_px": 384})  # 5.9 megapixels keep three threads busy
    assert JobResources(scene).threads(JOB) == 3
    tiny = plan(tmp_path, world={"views": 12, "image_px": 128})
    assert JobResources(tiny).threads(JOB) == 1
    # cores go to jobs before threads
    threads = {cores: JobResources(scene, cores).threads(JOB) for cores in (1, 2, 8)}
    assert threads == {1: 1, 2: 2, 8: 3}
    variants = len(scene.run.variant_names())
    assert JobResources(scene, variants).variant_threads(JOB) == 1
    few = JobResources(scene, variants + 1)
    assert few.variant_threads(JOB) == few.threads(JOB)
    many = plan(tmp_path, scenes=2, world={"views": 40, "image_px": 384})
    assert JobResources(many, 2).threads(JOB) == 1
    assert JobResources(many).threads(JOB) == 3, "a cluster doesn't know the cores of its nodes"


@pytest.mark.parametrize(
    ("cores", "on_machine", "gsplat_problem", "device", "segmenter", "expected"),
    [
        (2, ["0"], None, "auto", "sam", [1, 1, 1, 0]),
        (2, ["0"], "no nvcc", "auto", "sam", [0, 1, 1, 0]),
        (2, ["0"], None, "auto", "graph", [1, 0, 1, 0]),
        (2, ["0"], None, "cpu", "sam", [0, 0, 0, 0]),
        (2, [], None, "auto", "sam", [0, 0, 0, 0]),
        (2, [], None, "cuda", "sam", [1, 1, 1, 1]),  # an error later says that there is none
        (None, ["0"], None, "auto", "sam", [0, 0, 0, 0]),  # the nodes of a cluster are unknown
        (None, [], None, "cuda", "sam", [1, 1, 1, 1]),
    ],
)
def test_jobs_that_use_a_card_request_one(
    tmp_path, monkeypatch, cores, on_machine, gsplat_problem, device, segmenter, expected
):
    monkeypatch.setattr("hilsplat.workflow.resources.cards", lambda: on_machine)
    monkeypatch.setattr("hilsplat.workflow.resources.card_problem", lambda: None)
    monkeypatch.setattr("hilsplat.workflow.resources.expected_problem", lambda: gsplat_problem)
    sections = ("gaussians", "masks", "clip", "contributions")
    config = {section: {"device": device} for section in sections}
    config["masks"]["segmenter"] = segmenter
    found = JobResources(plan(tmp_path, **config), cores)
    assert [found.gpus(section)(JOB) for section in sections] == expected


def test_a_stage_of_a_plugin_that_reads_settings_with_a_device_requests_a_card(tmp_path, monkeypatch):
    def count(settings: ContributionsSettings, out: PathOut) -> None: ...

    monkeypatch.setitem(all_stages(), "count", Registry().stage()(count))
    resources = JobResources(plan(tmp_path, contributions={"device": "cuda"}), None).of("count")
    assert resources["gpu"](JOB) == 1


def test_the_size_of_a_scene_is_that_of_its_settings_until_its_cameras_can_be_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, cameras = plan(tmp_path), Path("results/synthetic/0/scene/cameras.npz")
    (row,) = found.rows
    planned = JobResources(found).size(row)
    cameras.parent.mkdir(parents=True)
    np.savez(cameras, size_hw=np.array([(500, 1000)] * 2, np.int32))
    assert JobResources(found).size(row) == (2, 0.5)
    flip_bit(cameras, 0.5)
    assert JobResources(found).size(row) == planned
    for damaged in (b"", b"PK"):
        cameras.write_bytes(damaged)
        assert JobResources(found).size(row) == planned


def test_the_number_of_gaussians_is_read_from_the_header_of_a_ply(tmp_path):
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 812430\nproperty float x\nend_header\n"
    (tmp_path / "existing.ply").write_bytes(header + bytes(10))
    assert vertex_count(tmp_path / "existing.ply") == 812_430
    (tmp_path / "other.ply").write_bytes(b"element vertexes 3")
    assert vertex_count(tmp_path / "other.ply") is None and vertex_count(tmp_path / "none.ply") is None


def test_frozen_gaussians_are_counted_in_the_mesh(tmp_path):
    scan = tmp_path / "scannet/scans/scene0000_00"
    for part in ("color/0.jpg", "pose/0.txt", "intrinsic/intrinsic_color.txt"):
        (scan / part).parent.mkdir(parents=True, exist_ok=True)
        (scan / part).touch()
    rows, job = (
        ("scannet scene0000_00 scannet data:scannet/scene0000_00 metre",),
        Job("scannet", "scene0000_00"),
    )

    def costs(vertices: int, **fit: object) -> list[float]:
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nend_header\n"
        for name in ("ply", "labels.ply", "0.010000.segs.json"):
            (scan / f"scene0000_00_vh_clean_2.{name}").write_text(header)
        (scan / "scene0000_00.aggregation.json").touch()
        config = {"data_root": str(tmp_path), "gaussians": {"max_gaussians": 2_000_000, **fit}}
        found = JobResources(plan_of(tmp_path, rows, groups=["scannet"], **config))
        of_job = [
            getattr(found, name)("gaussians", job) for name in ("core_seconds", "card_seconds", "disk_mb")
        ]
        return [found.gaussians(found.plan.scenes[0]), *of_job]

    small, large, growing = costs(80_000, initial="frozen"), costs(200_000, initial="frozen"), costs(80_000)
    assert [each[0] for each in (small, large, growing)] == [80_000, 200_000, 2_000_000]
    assert all(low < middle < high for low, middle, high in zip(small, large, growing, strict=True))


def test_memory_grows_with_the_model_and_with_views_at_once(tmp_path):
    folder = tmp_path / "models/sam"
    shutil.copytree(PROJECT / "models/sam-tiny", folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"vision_config": {"patch_size": 6}}))
    chosen = plan(tmp_path, masks={"model": str(folder)})

    def masks(threads: int) -> int:
        return JobResources(chosen).memory_mb("masks")(JOB, threads, attempt=1)

    # 35 arrays of 64 x 64 patches with 768 channels, 12 MiB each; attention of a row 42; decoder at 384 px 35
    assert masks(2) - masks(1) == pytest.approx((35 * 12 + 42 + 35) * 2**20 / 1e6, abs=100)
    for without in ({"segmenter": "graph", "model": str(folder)}, {"model": str(tmp_path / "nowhere")}):
        small = JobResources(plan(tmp_path, masks=without))
        assert small.memory_mb("masks")(JOB, 32, 1) < 1000 + RUNNER_MB


def test_the_time_of_an_evaluation_grows_with_the_labelled_queries(tmp_path, monkeypatch):
    """2092 queries of a scene with 40 views of 384 x 384 px took 74 CPU seconds (docs/benchmarks.md)."""
    monkeypatch.setattr(JobResources, "_size", lambda self, row: Size(40, 0.147))
    source = tmp_path / "photos"
    source.mkdir()
    shutil.copy(PROJECT / "docs/images/panel.jpg", source / "1.jpg")
    job, labels = Job("photos", "desk"), tmp_path / "annotated/photos/desk"
    labels.mkdir(parents=True)
    seconds = []
    for count in (10, 2092):
        objects = [{"category": "mug", "segmentation": []}] * count
        (labels / "1.json").write_text(json.dumps({"objects": objects}))
        found = plan_of(
            tmp_path, ("photos desk photos photos metre",), groups=["photos"], data_root=str(tmp_path)
        )
        seconds.append(JobResources(found).core_seconds("evaluate", job))
    unlabelled = JobResources(plan(tmp_path)).core_seconds("evaluate", JOB)
    assert seconds[0] == unlabelled and seconds[1] == pytest.approx(74 + 2, rel=0.02)


def test_masks_of_a_data_set_count_as_queries(tmp_path):
    masks = tmp_path / "3d_ovs/bed/segmentations"
    for view in ("00", "04"):
        (masks / view).mkdir(parents=True)
        for name in ("banana.png", "sheet.png"):
            (masks / view / name).touch()
    (masks / "classes.txt").write_text("banana\nsheet\n")
    (tmp_path / "3d_ovs/bed/images").mkdir()
    (tmp_path / "3d_ovs/bed/sparse").mkdir()
    rows = ("3d_ovs bed 3d_ovs data:3d_ovs/bed arbitrary", "synthetic one benchmark world:tabletop:1 metre")
    found = plan_of(tmp_path, rows, groups=["3d_ovs", "benchmark"], data_root=str(tmp_path))
    assert [found.data.num_labelled(row) for row in found.rows] == [4, 0]


def test_imported_gaussians_masks_and_vectors_cost_neither_a_fit_nor_a_model(tmp_path, monkeypatch):
    """The full-size models would take hours for 40 views."""
    monkeypatch.setenv("HILSPLAT_MODELS", str(tmp_path / "none"))
    sections = {
        "masks": {"segmenter": "sam", "model": "models/sam-vit-huge"},
        "clip": {"model": "models/clip-vit-b-16-laion2b"},
        "world": {"views": 40, "image_px": 512},
    }
    found = JobResources(plan(tmp_path, **sections), cores=2)
    (row,), computed = found.plan.rows, {}
    for rule in ("gaussians", "masks", "clip"):
        card_s = found.card_seconds(rule, JOB)
        computed[rule] = found.core_seconds(rule, JOB), found.memory_mb(rule)(JOB, 1, 1)
        assert card_s and card_s < computed[rule][0]
    assert found.candidates("masks", JOB)
    imported = replace(row, gaussians=tmp_path / "a.ply", features=tmp_path)
    monkeypatch.setattr(found.plan, "row", lambda job: imported)
    monkeypatch.setattr(found, "size", lambda row: Size(40, 0.26))
    assert found.candidates("masks", JOB) is None
    for rule, stage in (("gaussians", "gaussians"), ("imported_masks", "masks"), ("imported_clip", "clip")):
        seconds, memory_mb = computed[stage]
        assert found.card_seconds(rule, JOB) is None
        assert 2 <= found.core_seconds(rule, JOB) <= 62 < seconds
        assert found.minutes(rule)(JOB, 1, 1) == 10
        assert found.memory_mb(rule)(JOB, 1, 1) <= memory_mb - (1000 if stage == "masks" else 0)


def test_a_released_model_has_its_cost_before_it_is_fetched(tmp_path, monkeypatch):
    monkeypatch.setenv("HILSPLAT_MODELS", str(tmp_path / "none"))
    seconds, megabytes = {}, {}
    for name in ("sam-vit-huge", "sam2.1-hiera-small", "unknown"):
        masks = {"segmenter": "sam", "model": f"models/{name}"}
        found = JobResources(plan(tmp_path, masks=masks, world={"views": 10, "image_px": 128}))
        seconds[name] = found.core_seconds("masks", JOB)
        megabytes[name] = found.memory_mb("masks")(JOB, 1, 1)
    assert seconds["sam-vit-huge"] > seconds["sam2.1-hiera-small"] + 800 > 900
    assert seconds["unknown"] == 10 * 1.5 + 2, "as the embedded model"
    assert megabytes["sam-vit-huge"] > 2570 > megabytes["unknown"]
