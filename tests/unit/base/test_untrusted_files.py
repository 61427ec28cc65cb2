"""Files from outside: content never decides what runs, and sizes are checked before anything is decoded."""

import ast
import io
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from hilsplat.base.artifacts import read_npy, read_npz
from hilsplat.base.errors import ArtifactError, HilsplatError, ImageError, SceneError
from hilsplat.base.images import FORMATS, image_size_hw, open_image, read_image, require_usable_size
from hilsplat.base.levels import Level
from hilsplat.base.ownership import require_own_picture
from hilsplat.datasets.hierarchy import HierarchyAnnotations, label_path
from hilsplat.embed.langsplat_files import read_view
from hilsplat.evaluate.files_stage import read_view_masks
from hilsplat.photos.check import inspect_photos
from hilsplat.scene.poses import run_poses
from hilsplat.settings import PosesSettings
from hilsplat.workflow.resources import UNKNOWN_MP, _first_mp
from tests.conftest import PROJECT

READERS = {  # call -> files that may contain it
    "Image.open": {"hilsplat/base/images.py"},
    "av.open": {"hilsplat/photos/video.py", "hilsplat/splat/flyaround.py"},  # the second writes
    "yaml.load": {"hilsplat/configuration.py", "hilsplat/workflow/run.py"},  # with loaders of plain values
}
NOWHERE = (
    *("cv2.imread", "cv2.imdecode", "cv2.imreadmulti", "cv2.VideoCapture", "plt.imread", "imageio.imread"),
    *("pickle.load", "pickle.loads", "torch.load", "joblib.load", "pd.read_pickle"),
    *("yaml.unsafe_load", "yaml.full_load"),
)


def test_each_decoder_is_called_in_one_place():
    found: dict[str, set[str]] = {name: set() for name in (*READERS, *NOWHERE)}
    for path in [
        path for folder in ("hilsplat", "benchmarks", "models") for path in (PROJECT / folder).rglob("*.py")
    ]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            if name in found:
                found[name].add(path.relative_to(PROJECT).as_posix())
            if name == "np.load":
                words = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                assert words.get("allow_pickle", "False") == "False", path
    assert found == {**READERS, **{name: set() for name in NOWHERE}}


def write_eps(path: Path) -> Path:
    """Write an EPS file with the suffix of a photograph; decoding it runs `gs`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (40, 40)).save(path, format="EPS")
    return path


def label_image(path: Path) -> object:
    return HierarchyAnnotations(path.parents[1], (), {}).label_image("a", Level.WHOLE)


@pytest.mark.parametrize(
    "read",
    [
        read_image,
        image_size_hw,
        label_image,
        require_own_picture,
        lambda path: read_view_masks(path.parents[1], "labels"),
        lambda path: inspect_photos(path.parent).unreadable or pytest.fail("it was read"),
        lambda path: _first_mp([str(path)], 800) == UNKNOWN_MP or pytest.fail("it was read"),
    ],
)
def test_postscript_in_a_png_is_never_run(tmp_path, monkeypatch, read):
    path = write_eps(label_path(tmp_path, "a", Level.WHOLE))
    monkeypatch.setattr(
        EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("Ghostscript was started")
    )
    opened = Image.open
    monkeypatch.setattr(
        Image, "open", lambda *given, formats=None: opened(*given, formats=formats or pytest.fail("no list"))
    )
    try:
        read(path)
    except HilsplatError as error:
        assert "label" in str(error) or "a.whole.png" in str(error)


@pytest.mark.parametrize("kind", ["EPS", "GIF", "PPM", "TGA", "ICO"])
def test_other_formats_are_refused_whatever_the_suffix(tmp_path, kind):
    Image.new("RGB", (40, 40)).save(tmp_path / "a.png", format=kind)
    with pytest.raises(ImageError, match=r"a.png cannot be read: cannot identify"):
        read_image(tmp_path / "a.png")


def test_multi_picture_jpegs_of_phones_are_read(tmp_path):
    pictures = [Image.new("RGB", (40, 30), colour) for colour in ("red", "blue")]
    pictures[0].save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=pictures[1:])
    assert open_image(tmp_path / "a.jpg").format == "MPO" and "MPO" not in FORMATS
    assert read_image(tmp_path / "a.jpg").shape == (30, 40, 3)


def test_an_llff_image_that_cannot_be_read_is_refused(tmp_path):
    rows = np.zeros((1, 17))
    rows[0, :15] = np.column_stack([[0, -1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 0], [40, 40, 40]]).ravel()
    np.save(tmp_path / "poses_bounds.npy", rows)
    write_eps(tmp_path / "images/a.png")
    with pytest.raises(SceneError, match=r"a.png cannot be read"):
        run_poses(tmp_path, tmp_path / "out", "photos/a", "metre", False, PosesSettings(), 0, 1)


def png(width: int, height: int) -> bytes:
    """Return a valid PNG of zeros, one bit per pixel; large ones are only a little longer."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    packer = zlib.compressobj(9)
    row = bytes(1 + (width + 7) // 8)
    data = b"".join(packer.compress(row * min(256, height - at)) for at in range(0, height, 256))
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", data + packer.flush()), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_pictures_with_many_pixels_are_refused_before_decoding(tmp_path, monkeypatch):
    from PIL import ImageFile

    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda *_: pytest.fail("it was decoded"))
    (tmp_path / "a.png").write_bytes(png(28_000, 28_000))
    with pytest.raises(ImageError, match=r"is too large: .*784000000 pixels"):
        read_image(tmp_path / "a.png")
    with pytest.raises(ImageError, match=r"is too large: 4097 x 8 px\n.*4096 px per side"):
        read_image(io.BytesIO(png(4097, 8)), max_side_px=4096)


@pytest.mark.parametrize(
    ("size_hw", "max_side_px", "is_usable"),
    [
        ((16, 16), 800, True),
        ((15, 300), 800, False),
        ((16, 320), 800, True),
        ((16, 321), 800, False),
        ((1, 64), 800, False),
        ((0, 0), 800, False),
        ((200, 800), 64, True),
        ((190, 800), 64, False),  # 15 px after shrinking
    ],
)
def test_photographs_need_sides_that_all_stages_can_process(size_hw, max_side_px, is_usable):
    if is_usable:
        require_usable_size("a.png", size_hw, max_side_px)
        require_usable_size("a.png", size_hw[::-1], max_side_px)
    else:
        with pytest.raises(
            ImageError, match=f"a.png is too small or too narrow: {size_hw[1]} x {size_hw[0]} px"
        ):
            require_usable_size("a.png", size_hw, max_side_px)


def packed(shape: tuple[int, ...], data: bytes = bytes(16), kind: str = "|b1") -> bytes:
    """Return an .npy file with any shape in its header."""
    stream = io.BytesIO()
    described = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, described)
    return stream.getvalue() + data


SHAPES = [(10**12,), (10**12, 10**12), (10**30,), (-5,), (10**6, 10**6)]


@pytest.mark.parametrize("shape", SHAPES)
def test_arrays_that_state_an_impossible_shape_are_refused(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(packed(shape))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", packed(shape))
    for read, name in ((read_npy, "a.npy"), (read_npz, "a.npz")):
        with pytest.raises(ArtifactError, match=f"{name} cannot be read"):
            read(tmp_path / name)


def test_one_array_in_place_of_an_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(packed((16,)))
    with pytest.raises(ArtifactError, match=r"a.npz cannot be read"):
        read_npz(tmp_path / "a.npz")


def test_predicted_masks_that_unpack_to_gigabytes_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("mug.npy", packed((2**15, 2**15)))
        archive.filelist[0].file_size = 3 * 2**30  # zeros of this size would compress to 3 MB
    with pytest.raises(ArtifactError, match=r"unpacks to 3.0 GiB, but the limit is 2.0 GiB"):
        read_view_masks(tmp_path, "a.png")


def test_predicted_masks_of_text_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", mug=np.array([["x"]]))
    with pytest.raises(ArtifactError, match=r"a.npz: mug is not two-dimensional, or not numeric"):
        read_view_masks(tmp_path, "a.png")


def test_langsplat_maps_without_pixels_are_refused(tmp_path):
    np.save(tmp_path / "a_s.npy", np.zeros((4, 0, 9), np.float32))
    np.save(tmp_path / "a_f.npy", np.zeros((1, 3), np.float32))
    with pytest.raises(ArtifactError, match=r"a_s.npy is not a LangSplat map"):
        read_view(tmp_path, "a.png")
