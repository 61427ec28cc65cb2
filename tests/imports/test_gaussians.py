"""Gaussians of other programs: filters, unknown properties, unusable rows, and what is refused."""

import gzip

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from hilsplat.base.errors import ArtifactError
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.splat.coordinates import import_gaussians, read_gaussians
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import import_ply, load_ply

NAMES = (
    [*"xyz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(9)), "opacity"]
    + [f"scale_{k}" for k in range(3)]
    + [f"rot_{k}" for k in range(4)]
)


def columns(rows=8) -> dict[str, np.ndarray]:
    """Columns of Gaussians of degree 1, as plain numbers that differ in every place."""
    rng = np.random.default_rng(5)
    return {name: rng.normal(size=rows).astype(np.float32) for name in NAMES}


def write(path, table: dict[str, np.ndarray], *, text=False, order="<", elements=(), comments=()):
    rows = len(next(iter(table.values())))
    data = np.empty(rows, [(name, values.dtype) for name, values in table.items()])
    for name, values in table.items():
        data[name] = values
    every = [*elements, PlyElement.describe(data, "vertex")]
    PlyData(every, text=text, byte_order="=" if text else order, comments=list(comments)).write(str(path))
    return path


def added(*names, kind=np.float32):
    return lambda table: {**table, **{name: np.full(len(table["x"]), 1, kind) for name in names}}


def assert_rows(found: Gaussians, table, rows=slice(None), but=()):
    """Compare with the columns of a table, place by place."""
    expected = {
        "means": [table[name] for name in "xyz"],
        "log_scales": [table[f"scale_{k}"] for k in range(3)],
        "quats": [table[f"rot_{k}"] for k in range(4)],
        "opacity_logits": table["opacity"],
    }
    for name, values in expected.items():
        if name not in but:
            np.testing.assert_allclose(getattr(found, name), np.transpose(values)[rows], rtol=1e-6)
    for channel in range(3):
        np.testing.assert_allclose(found.sh[:, 0, channel], table[f"f_dc_{channel}"][rows], rtol=1e-6)
        for k in range(3):
            np.testing.assert_allclose(
                found.sh[:, 1 + k, channel], table[f"f_rest_{3 * channel + k}"][rows], rtol=1e-6
            )


# ---- filter_3D ------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [False, True], ids=["binary", "ascii"])
def test_the_3d_filter_widens_scales_and_lowers_opacities(tmp_path, text):
    """Scales 3, 4, 12 with a filter of 4 become sqrt(9 + 16) = 5, sqrt(32) and sqrt(160). An opacity of 0.8
    becomes 0.8 * 3 * 4 * 12 / (5 * sqrt(32) * sqrt(160)) = 0.32199. A filter of 0 changes nothing."""
    table = columns(2)
    table["opacity"][:] = np.log(0.8 / 0.2)
    for k, scale in enumerate((3, 4, 12)):
        table[f"scale_{k}"][:] = np.log(scale)
    path = write(tmp_path / "mip.ply", {**table, "filter_3D": np.array([4, 0], np.float32)}, text=text)
    found, notes, _ = import_ply(path, "")
    np.testing.assert_allclose(np.exp(found.log_scales), [[5, 32**0.5, 160**0.5], [3, 4, 12]], rtol=1e-6)
    np.testing.assert_allclose(found.opacities, [0.321994, 0.8], rtol=1e-5)
    assert_rows(found, table, but=("log_scales", "opacity_logits"))
    assert len(notes) == 1 and "filter_3D" in notes[0]
    with pytest.raises(ArtifactError, match="filter_3D"):
        load_ply(path)


def test_the_3d_filter_is_exact_for_extreme_opacities_and_scales(tmp_path):
    """In float64, by the formula with alphas instead of logits; an infinite logit is an alpha of 1."""
    table = columns(5)
    scales = np.array([1e-6, 1e-3, 1.0, 50.0, 1e-12])
    logits, filters = np.array([-12, 14, np.inf, 3, 0.0]), np.array([1e-5, 1e-6, 0.5, 0.0, 1e-3])
    table["opacity"] = logits.astype(np.float32)
    for k in range(3):
        table[f"scale_{k}"] = np.log(scales * (k + 1))
    found, *_ = import_ply(write(tmp_path / "g.ply", {**table, "filter_3D": filters}), "")
    before = scales[:, None] * (1, 2, 3)
    after = np.sqrt(before**2 + filters[:, None] ** 2)
    alpha = 1 / (1 + np.exp(-logits)) * np.sqrt(np.prod(before**2, 1) / np.prod(after**2, 1))
    np.testing.assert_allclose(np.exp(found.log_scales.astype(np.float64)), after, rtol=3e-6)
    np.testing.assert_allclose(found.opacities.astype(np.float64), alpha, rtol=2e-5)


# ---- properties and elements ------------------------------------------------------------------------


READ = {
    "nerfstudio: normals, colours": added("nx", "ny", "nz", "red", "green", "blue", kind=np.uint8),
    "Gaussian Grouping": added(*(f"obj_dc_{k}" for k in range(16))),
    "OpenGaussian": added("ins_feat_r", "ins_feat_g", "ins_feat_b"),
    "Feature 3DGS": added(*(f"semantic_{k}" for k in range(5))),
    "labels": added("label", "instance_id", kind=np.int32),
    "Brush: another order": lambda c: {name: c[name] for name in sorted(c, key=lambda n: n[::-1])},
    "doubles": lambda c: {name: values.astype(np.float64) for name, values in c.items()},
}


@pytest.mark.parametrize("form", READ)
@pytest.mark.parametrize("how", ["little", "big", "ascii"])
def test_forms_of_other_programs_are_read_silently(tmp_path, form, how):
    table = columns()
    sharp = [PlyElement.describe(np.zeros(9, [("intrinsic", "f4")]), "intrinsic")]
    sharp += [PlyElement.describe(np.zeros(1, [("color_space", "u1")]), "color_space")]
    path = write(
        tmp_path / "g.ply",
        READ[form](table),
        text=how == "ascii",
        order=">" if how == "big" else "<",
        elements=sharp if how == "little" else (),
        comments=["Vertical Axis: z"],
    )
    found, notes, unknown = import_ply(path, "")
    assert_rows(found, table)
    assert (notes, unknown) == ([], [])


def test_unknown_properties_and_elements_are_named_once(tmp_path):
    table = added("albedo_0", "albedo_1", "roughness")(columns())
    layers = PlyElement.describe(np.zeros(2, [("depth", "f4")]), "layers")
    found, notes, unknown = import_ply(write(tmp_path / "g.ply", table, elements=[layers]), "")
    assert_rows(found, table)
    assert (notes, unknown) == ([], ["albedo_*", "layers", "roughness"])


@pytest.mark.parametrize(("mode", "noted"), [("mip", True), ("default", False)])
def test_antialiased_training_is_noted(tmp_path, mode, noted):
    comments = ["Exported from Brush", f"SplatRenderMode: {mode}"]
    _, notes, _ = import_ply(write(tmp_path / "g.ply", columns(), comments=comments), "")
    assert ["antialiasing, which is not applied" in note for note in notes] == [True] * noted


REFUSED = {
    "4DGS": (added("t", "scale_t_0", "rot_r_0"), "changes over time"),
    "SpacetimeGaussians": (added("trbf_center", "trbf_scale_0", "motion_0", "omega_0"), "changes over time"),
    "velocities": (added("velocity_x"), "changes over time"),
    "Scaffold-GS": (added("f_offset_0", "f_anchor_feat_0", "scale_3", "scale_4", "scale_5"), "anchors"),
    "beta splatting": (added("beta"), "kernels"),
    "spherical beta": (added("sb_params_0"), "kernels"),
    "generalised exponentials": (added("shape"), "kernels"),
    "SuperSplat's compression": (
        lambda c: {f"packed_{name}": np.zeros(8, np.uint32) for name in ("position", "scale", "color")},
        "compressed",
    ),
    "2DGS": (lambda c: {k: v for k, v in c.items() if k != "scale_2"}, "flat disks"),
    "one scale": (lambda c: {k: v for k, v in c.items() if k not in ("scale_1", "scale_2")}, "scale_1"),
    "view-dependent opacity": (added("opacity_rest_0"), "opacity_rest_0"),
    "another filter": (added("mip_filter"), "mip_filter"),
    "indices into a codebook": (lambda c: {**c, "scale_1": np.ones(8, np.uint8)}, "not floats: scale_1"),
    "two harmonics": (
        lambda c: {k: v for k, v in c.items() if k[:6] != "f_rest" or k[7:] in "01"},
        "2 f_rest",
    ),
    "no numbers": (lambda c: {k: v * np.float32(np.nan) for k, v in c.items()}, "8 of 8 Gaussians contain"),
    "colours only": (lambda c: {k: v for k, v in c.items() if k[:2] != "f_"}, "f_dc_0"),
    "degree 4": (added(*(f"f_rest_{k}" for k in range(9, 72))), "72 f_rest columns"),
}


@pytest.mark.parametrize("form", [*REFUSED, "delta_vertex_0", "chunk", "codebook_centers"])
def test_forms_and_elements_that_mean_something_else_are_refused_by_name(tmp_path, form):
    change, words = REFUSED.get(form, (dict, form))
    elements = () if form in REFUSED else [PlyElement.describe(np.zeros(2, [("value", "f4")]), form)]
    path = write(tmp_path / "theirs.ply", change(columns()), elements=elements)
    with pytest.raises(ArtifactError, match=rf"theirs\.ply(.|\n)*{words}(.|\n)*export it plainly"):
        import_ply(path, "export it plainly")


OTHER_FILES = [gzip.compress(b"NGSP", mtime=0), b"PK\x03\x04", b"\0" * 320, b"", b"ply\n"]


@pytest.mark.parametrize("content", [*OTHER_FILES, b"ply\nformat ascii 1.0\nend_header\n"])
def test_files_of_other_formats_are_refused_with_a_program_that_converts_them(tmp_path, content):
    (tmp_path / "desk.spz").write_bytes(content)
    with pytest.raises(ArtifactError, match=r"desk\.spz cannot be read: (.|\n)*SuperSplat"):
        read_gaussians(tmp_path / "desk.spz")


# ---- rows --------------------------------------------------------------------------------------------


def test_infinite_opacities_are_clamped(tmp_path):
    table = columns()
    table["opacity"][[1, 3, 4]] = np.inf, -np.inf, np.inf
    path = write(tmp_path / "g.ply", table)
    found, notes, _ = import_ply(path, "")
    assert_rows(found, table, but=("opacity_logits",))
    assert np.isfinite(found.opacity_logits).all()
    np.testing.assert_allclose(found.opacities[[1, 3, 4]], [1, 0, 1], atol=1e-6)
    np.testing.assert_array_equal(found.opacity_logits[[0, 2, 5]], table["opacity"][[0, 2, 5]])
    assert len(notes) == 1 and notes[0].startswith("3 infinite opacities")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("x", np.nan),
        ("opacity", np.nan),
        ("f_rest_8", np.inf),
        ("scale_0", -np.inf),
        ("rot_2", np.nan),
        ("y", 1e30),
        ("z", 1e300),  # not a float32
        ("scale_2", 60.0),
        ("filter_3D", np.nan),
    ],
)
def test_unusable_rows_are_left_out_and_counted(tmp_path, name, value):
    table = columns()
    table[name] = table.get(name, np.zeros(8)).astype(np.float64)
    table[name][[2, 6]] = value
    found, notes, _ = import_ply(write(tmp_path / "g.ply", table), "")
    table.pop("filter_3D", None)
    assert_rows(found, table, [0, 1, 3, 4, 5, 7])
    assert "left out: 2 of 8 Gaussians" in notes[-1]
    with pytest.raises(ArtifactError):
        load_ply(tmp_path / "g.ply")


@pytest.mark.parametrize(("bad", "is_read"), [(4, True), (5, False), (8, False)])
def test_more_than_half_unusable_rows_refuse_the_file(tmp_path, bad, is_read):
    table = columns()
    for k in range(4):
        table[f"rot_{k}"][:bad] = 0
    path = write(tmp_path / "g.ply", table)
    if is_read:
        assert_rows(import_ply(path, "")[0], table, slice(bad, None))
    else:
        with pytest.raises(ArtifactError, match=rf"{bad} of 8 Gaussians(.|\n)*export again"):
            import_ply(path, "export again")


def sizes_and_opacities(scales=np.log, opacities=lambda alpha: np.log(alpha / (1 - alpha)), unit=0.02):
    """Columns of Gaussians of usual sizes, in a unit."""
    rng, table = np.random.default_rng(2), columns(400)
    for k in range(3):
        table[f"scale_{k}"] = scales(unit * rng.lognormal(sigma=1.2, size=400))
    return {**table, "opacity": opacities(rng.uniform(0.01, 0.99, 400))}


@pytest.mark.parametrize(
    ("how", "is_read"),
    [({"scales": np.array}, False), ({"opacities": np.array}, False), ({"unit": 20.0}, True), ({}, True)],
)
def test_scales_and_opacities_without_logarithm_and_logit_are_refused(tmp_path, how, is_read):
    path = write(tmp_path / "g.ply", sizes_and_opacities(**how))
    if is_read:
        assert len(import_ply(path, "")[0]) == 400
    else:
        with pytest.raises(ArtifactError, match=r"g\.ply does not contain(.|\n)*scale_\* from .*, opacity"):
            import_ply(path, "")


# ---- damage ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("comment", ["TextureFile Täxtur.png", "名前", "a" * 5000 + "é"])
def test_comments_in_other_alphabets_are_read(text, comment, tmp_path):
    table = columns()
    path = write(tmp_path / "g.ply", table, text=text, comments=["by us"])
    for encoding in ("utf-8", "utf-16", "latin-1"):
        theirs = tmp_path / "theirs.ply"
        written = comment.encode(encoding, "replace").replace(b"\n", b"")
        theirs.write_bytes(path.read_bytes().replace(b"by us", written))
        assert_rows(import_ply(theirs, "")[0], table)


def test_notes_are_logged_and_recorded(tmp_path, caplog):
    table = {**columns(), "filter_3D": np.ones(8, np.float32), "gloss": np.ones(8, np.float32)}
    table["x"][0] = np.nan
    none, pose = np.zeros((0, 3)), np.eye(4)
    cameras = Cameras(("a.png",), pose[None], np.eye(3)[None], np.int32([[4, 4]]))
    points = none.astype(np.float32), none.astype(np.uint8)
    scene = Scene(tmp_path, "photos/desk", "metre", cameras, {"a.png": "train"}, *points, pose)
    with caplog.at_level("INFO"):
        gaussians, origin = import_gaussians(write(tmp_path / "g.ply", table), scene)
    assert len(gaussians) == 7
    for words in ("filter_3D was applied", "gloss", "left out: 1 of 8"):
        assert words in caplog.text and any(words in note for note in origin["notes"])
