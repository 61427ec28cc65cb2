"""Memory use of models, free memory, and the number of views at once."""

from pathlib import Path

import pytest

from hilsplat.base.memory import available_mib, machine_mib
from hilsplat.models.folder import ModelFolder
from hilsplat.models.int8 import reduced_precision
from hilsplat.models.memory import PROCESS_MIB, Needs, needs_of


def folder(tmp_path, layout: str, config: dict, size: int, megabytes: int = 0) -> ModelFolder:
    network = tmp_path / "vision_encoder.onnx"
    with network.open("wb") as file:
        file.truncate(megabytes * 2**20)
    preprocessing = {"size": size}
    return ModelFolder(tmp_path, layout, config, preprocessing, {"vision_encoder": network}, (network,))


def test_views_at_once_by_hand(monkeypatch):
    monkeypatch.setattr("hilsplat.models.memory.available_mib", lambda: 16384.0)
    needs = Needs(weights_mib=500.0, view_mib=3000.0)
    # 16 GiB less the process and the weights: 14384 MiB hold four views
    assert needs.views_at_once(32, None) == needs.views_at_once(32, 20000.0) == 4
    assert needs.views_at_once(2, None) == 2
    assert needs.views_at_once(32, 1000.0) == 1
    assert needs.total_mib(4) == PROCESS_MIB + 500 + 12000


def test_the_estimates_for_vit_b_agree_with_the_measurements(tmp_path):
    # a picture 475 MiB row by row and 2615 as exported, 8 prompts as exported 507, open weights 417
    model = folder(tmp_path, "sam", {"vision_config": {}}, 1024, 357)
    assert needs_of(model, batch=8).view_mib == pytest.approx(475 + 250, rel=0.05)
    exported = needs_of(model, batch=8, as_exported=True)
    assert exported.view_mib == pytest.approx(2615 + 507, rel=0.05)
    assert exported.weights_mib == pytest.approx(417, rel=0.05)
    huge = folder(tmp_path, "sam", {"vision_config": {"num_attention_heads": 16}}, 1024)  # 16 heads, not 12
    view_mib = needs_of(huge, batch=8, as_exported=True).view_mib
    assert view_mib - 512 == pytest.approx((exported.view_mib - 512) * 16 / 12)
    edge = {"vision_config": {"backbone_config": {"model_type": "timm_wrapper"}}}  # no heads are listed
    edgetam = needs_of(folder(tmp_path, "sam2", edge, 1024), batch=16).view_mib
    assert edgetam - 250 == pytest.approx((exported.view_mib - 512) * 4 / 12, rel=0.01)
    clip = needs_of(folder(tmp_path, "clip", {"vision_config": {}}, 224), batch=64)
    assert clip.view_mib == pytest.approx(521, rel=0.25)
    resnet = {"vision_cfg": {"image_size": 224, "patch_size": None}}  # open_clip's RN50
    assert needs_of(folder(tmp_path, "open_clip", resnet, 224), batch=64) == clip


@pytest.mark.parametrize(("megabytes", "auto"), [(1, True), (2, False)])
def test_int8_of_a_large_network_is_used_only_if_it_is_required(tmp_path, monkeypatch, megabytes, auto):
    monkeypatch.setattr("hilsplat.models.int8.LARGE_BYTES", 1_500_000)
    model = folder(tmp_path, "sam", {}, 1024, megabytes)
    assert reduced_precision("auto", model, "vision_encoder") == ("int8" if auto else "")
    assert reduced_precision("int8", model, "vision_encoder") == "int8"
    assert reduced_precision("fp32", model, "vision_encoder") == ""
    on_card = [reduced_precision(each, model, "vision_encoder", "cuda") for each in ("auto", "int8", "fp32")]
    assert on_card == ["fp16", "", ""]


GIB, UNLIMITED = 2**30, 9223372036854771712
V1, V2 = "9:cpuset:/\n4:cpu,memory:/a/b\n0::/\n", "0::/a/b\n"


def write_system(folder: Path, membership: str, groups: dict) -> None:
    """Write `proc` and `sys` of a process: limit, use and reclaimable pages by control group."""
    mount, limit_file, use_file, pages = "", "memory.max", "memory.current", "inactive_file"
    if membership == V1:
        mount, pages = "memory", "total_inactive_file"
        limit_file, use_file = "memory.limit_in_bytes", "memory.usage_in_bytes"
    files = {"proc/meminfo": f"MemTotal: {64 * 2**20} kB\nMemAvailable: {16 * 2**20} kB\n"}
    if membership:
        files["proc/self/cgroup"] = membership
    for group, (limit, used, reclaimable) in groups.items():
        place = f"sys/fs/cgroup/{mount}{group}"
        files[f"{place}/{limit_file}"] = f"{limit}\n"
        files[f"{place}/{use_file}"] = f"{used}\n"
        files[f"{place}/memory.stat"] = f"cache 1\nother_{pages} 7\n{pages} {reclaimable}\n"
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("membership", "groups", "limit_gib", "free_gib"),
    [
        # the own group: 5 GiB used, of which 2 GiB are file pages
        (V2, {"/a/b": (8 * GIB, 5 * GIB, 2 * GIB)}, 8, 5),
        (V1, {"/a/b": (8 * GIB, 5 * GIB, 2 * GIB)}, 8, 5),
        # an ancestor has the lower limit, or less free memory
        (V1, {"/a": (4 * GIB, GIB, 0), "/a/b": (UNLIMITED, GIB, 0)}, 4, 3),
        (V2, {"": (9 * GIB, 8 * GIB, 0), "/a/b": (4 * GIB, GIB, 0)}, 4, 1),
        # namespaces: the mount shows the own group, whatever its path is called
        (V1, {"": (8 * GIB, 5 * GIB, 0)}, 8, 3),
        ("0::/../../other\n", {"": (8 * GIB, 5 * GIB, 0)}, 8, 3),
        # other groups, no limit, no groups
        (V2, {"/a/b": ("max", GIB, 0), "/a/c": (GIB, 0, 0), "/c": (GIB, 0, 0)}, 64, 16),
        (V1, {"/a/b": (UNLIMITED, GIB, 0)}, 64, 16),
        ("", {"": (GIB, 0, 0)}, 64, 16),
    ],
)
def test_memory_limits_of_control_groups(tmp_path, monkeypatch, membership, groups, limit_gib, free_gib):
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 64 * GIB // 4096}.__getitem__)
    monkeypatch.setattr("hilsplat.base.memory.SYSTEM", tmp_path)
    write_system(tmp_path, membership, groups)
    assert machine_mib() == 1024 * limit_gib
    assert available_mib() == 1024 * free_gib
