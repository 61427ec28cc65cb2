"""Photographs are posed, or refused with names and numbers; lost ones are drawn; EXIF has focal lengths."""

import json
import re
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from hilsplat.base import images
from hilsplat.base.errors import ImageError, RegistrationError, SceneError
from hilsplat.base.images import read_image
from hilsplat.scene import mapping, poses
from hilsplat.scene.features import WorkImage, exif_focal_px, exif_time, lenses_of, prepare_images
from hilsplat.scene.posed_images import PosedImage, write_posed_images
from hilsplat.scene.poses import check_registration, name_neighbours, plot_lost, run_poses
from hilsplat.scene.scene import Scene
from hilsplat.scene.view_names import view_name, view_names
from hilsplat.settings import PosesSettings
from hilsplat_world.views import numbered_cameras


def pose_photos(folder, out, **settings):
    run_poses(folder, out, "photos/test", "arbitrary", False, PosesSettings(**settings), 0, 1)


def write_noise(folder, count, size_hw=(48, 48), suffix=".png"):
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        pixels = np.random.default_rng(number).integers(0, 256, (*size_hw, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}{suffix}")
    return folder


def plane_views(folder, views=5, size=160, step_deg=9, place=1):
    """Render a textured corner (the planes x = 0 and y = 0) from an arc, and return the cameras."""
    folder.mkdir()
    noise = np.random.default_rng(place).random((2, 64, 64, 3)).repeat(4, axis=1).repeat(4, axis=2)
    angles = np.radians(45 + step_deg * (np.arange(views) - (views - 1) / 2))
    centres = np.column_stack([4 * np.cos(angles), 4 * np.sin(angles), 1 + 0.2 * (np.arange(views) % 2)])
    cameras = numbered_cameras([(centre, np.zeros(3)) for centre in centres], size, fov_deg=45)
    y, x = np.mgrid[:size, :size] + 0.5
    for name, centre in zip(cameras.names, centres, strict=True):
        camera = cameras[name]
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T
        rays = rays @ camera.cam_from_world[:3, :3]
        image = np.zeros((size, size, 3))
        nearest = np.full((size, size), np.inf)
        for wall in (0, 1):  # the planes x = 0 and y = 0, seen from x, y > 0
            depth = -centre[wall] / rays[..., wall]
            hit = centre + depth[..., None] * rays
            inside = (depth > 0) & (depth < nearest) & (hit[..., 1 - wall] >= 0)
            u, v = hit[..., 1 - wall] * 60, (hit[..., 2] + 4) * 30
            texel = noise[wall][v.astype(int).clip(0, 255), u.astype(int).clip(0, 255)]
            image[inside] = texel[inside]
            nearest[inside] = depth[inside]
        Image.fromarray((image * 255).astype(np.uint8)).save(folder / name)
    return cameras


def test_too_few_or_damaged_photographs_are_refused_with_all_names(tmp_path):
    with pytest.raises(SceneError, match=r"at least 3 overlapping(.|\n)*found +2"):
        pose_photos(write_noise(tmp_path / "photos", 2), tmp_path / "scene")
    folder = write_noise(tmp_path / "photos", 3)
    (folder / "empty.jpg").touch()
    with pytest.raises(ImageError, match=r"empty\.jpg cannot be read"):
        pose_photos(folder, tmp_path / "scene", min_registered_share=0.8)
    (folder / "half.png").write_bytes((folder / "0.png").read_bytes()[:2000])
    (folder / "lost.png").symlink_to("gone.png")
    with pytest.raises(ImageError, match=r"3 of 6 images(.|\n)*empty\.jpg(.|\n)*half\.png(.|\n)*lost\.png"):
        pose_photos(folder, tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]  # no scene, no work folder


def test_renders_are_posed_with_unchanged_pixels_and_reruns_are_identical(tmp_path):
    cameras = plane_views(tmp_path / "renders")
    renders, first = tmp_path / "renders", tmp_path / "first"
    for out, threads in ((first, 1), (tmp_path / "second", 2)):
        run_poses(renders, out, "world/corner", "metre", True, PosesSettings(), 0, threads)
    scene = Scene.load(first)
    assert tuple(scene.views("train")) == cameras.names  # too few for a test view
    assert scene.unit == "arbitrary"  # structure from motion cannot recover the metric scale
    np.testing.assert_array_equal(scene.image("002.png"), read_image(renders / "002.png"))

    def relative_distances(cameras):
        """Do not depend on the similarity that SfM leaves undetermined."""
        centres = np.array([cameras[view].centre for view in cameras.names])
        distances = np.linalg.norm(centres[1:] - centres[0], axis=1)
        return distances / distances[-1]

    np.testing.assert_allclose(relative_distances(scene.cameras), relative_distances(cameras), rtol=0.05)
    report = json.loads((first / "registration.json").read_text())
    assert (report["images"], report["registered"], report["models"]) == (5, 5, [5])
    assert report["mean_reprojection_error_px"] < 1
    for file in first.rglob("*.*"):
        assert file.read_bytes() == (tmp_path / "second" / file.relative_to(first)).read_bytes(), file


def test_points_are_triangulated_from_known_poses(tmp_path):
    renders = tmp_path / "renders"
    cameras = plane_views(renders, views=3)
    posed = [cameras[name] for name in cameras.names]
    images = [PosedImage(c.name, renders / c.name, c.cam_from_world, c.K, c.size_hw) for c in posed]
    write_posed_images(tmp_path / "known", images)
    run_poses(tmp_path / "known", tmp_path / "scene", "world/corner", "metre", True, PosesSettings(), 0, 1)
    scene = Scene.load(tmp_path / "scene")
    source_from_scene = np.linalg.inv(scene.scene_from_source)
    points = scene.points_xyz @ source_from_scene[:3, :3].T + source_from_scene[:3, 3]
    assert len(points) >= 100
    # every true point lies on x = 0 or y = 0; 4 units away one pixel is 0.02
    assert np.median(np.abs(points[:, :2]).min(axis=1)) < 0.02
    report = json.loads((tmp_path / "scene" / "registration.json").read_text())
    assert report["points_from"] == "triangulated from the known poses"


def test_the_global_mapper_poses_the_renders_too(tmp_path):
    plane_views(tmp_path / "renders")
    pose_photos(tmp_path / "renders", tmp_path / "scene", mapper="global")
    assert len(Scene.load(tmp_path / "scene").cameras) == 5


def test_views_are_named_after_files_and_collisions_are_refused(tmp_path):
    assert view_name("DSC_1") == "DSC_1.png"
    assert view_names([tmp_path / "DSC_1.jpg", tmp_path / "a.b.PNG"]) == ["DSC_1.png", "a.b.png"]
    twice = [tmp_path / "train" / "r_0.png", tmp_path / "test" / "r_0.png"]
    assert view_names(twice) == ["train_r_0.png", "test_r_0.png"]
    with pytest.raises(SceneError, match=r"same view name 1\.png"):
        view_names([tmp_path / "1.jpg", tmp_path / "1.png"])
    pairs = [tmp_path / f"IMG_{row}{suffix}" for row in range(9) for suffix in (".heic", ".jpg")]
    with pytest.raises(SceneError, match=r"same view name IMG_0\.png, and so on for 9 names"):
        view_names(pairs)
    with pytest.raises(SceneError, match="brace"):
        view_names([tmp_path / "a{1}.png"])


def test_photographs_share_a_camera_when_size_and_focal_length_agree(tmp_path):
    images = [
        WorkImage(f"{row}.png", tmp_path / f"{row}.jpg", size, focal)
        for row, (size, focal) in enumerate([((3, 4), None), ((4, 3), None), ((3, 4), None), ((3, 4), 5.0)])
    ]
    model = "SIMPLE_PINHOLE"
    guessed = [(["0.png", "2.png"], model, None), (["1.png"], model, None)]
    assert lenses_of(images, model, "auto") == [*guessed, (["3.png"], model, [5.0, 2.0, 1.5])]
    assert [views for views, _, _ in lenses_of(images, model, "no")] == [[f"{row}.png"] for row in range(4)]
    of_sizes = [["0.png", "2.png", "3.png"], ["1.png"]]
    assert [views for views, _, _ in lenses_of(images, model, "yes")] == of_sizes


def found(registered, models):
    lost = {"registered": False, "why_not": "no features"}
    views = {f"{n}.png": {**lost, "file": f"{n}.jpg", "registered": n < registered} for n in range(10)}
    return {"images": 10, "registered": registered, "models": models, "warnings": [], "views": views}


def test_too_few_registered_photographs_are_refused_with_all_reasons(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a configuration that was run here would be in the advice

    def check(registered, models):
        settings = PosesSettings(min_registered_share=0.7)
        out, report = Path("results/photos/test/scene"), found(registered, models)
        check_registration(Path("photos"), out, "photos/test", report, settings)

    check(7, [7, 3])
    command = re.escape("""hilsplat run photos/test -- --config 'poses={"min_registered_share": 0.6}'""")
    message = rf"at least 70% of 10.*6 \(60\.0%\); models of 6, 4 .*9\.jpg: no features.*{command}"
    with pytest.raises(RegistrationError, match=f"(?s){message}"):
        check(6, [6, 4])
    with pytest.raises(
        RegistrationError, match=r"(?s)too few photographs.*models of no views.*0\.jpg: no features"
    ):
        check(0, [])


def test_lost_views_belong_near_the_registered_ones_with_most_shared_matches():
    views = {name: {"registered": name not in "ad"} for name in "abcde"}
    name_neighbours({"a": {"b": 3, "c": 9, "d": 5, "e": 7}, "d": {"a": 5}}, views)
    near = [{"view": "c", "matches": 9}, {"view": "e", "matches": 7}, {"view": "b", "matches": 3}]
    assert views["a"]["belongs_near"] == near
    assert views["d"]["belongs_near"] == []
    assert "belongs_near" not in views["b"]


def test_the_picture_has_a_row_for_each_lost_view(tmp_path):
    write_noise(tmp_path, 3)
    lost = {"registered": False, "file": "a.jpg", "why_not": "too few matches: none"}
    near = [{"view": "2.png", "matches": 20}]
    views = {"0.png": {**lost, "belongs_near": near}, "1.png": {**lost, "belongs_near": []}}
    pictures = []
    for file in ("b.jpg", "c.jpg"):  # titles are names of the user's files
        report = {"images": 3, "views": {**views, "2.png": {"registered": True, "file": file}}}
        plot_lost(tmp_path / file, tmp_path, report)
        pictures.append((tmp_path / file).read_bytes())
    assert Image.open(tmp_path / "b.jpg").size == (1200, 120 + 2 * 210)
    assert pictures[0] != pictures[1]


def test_an_unrelated_photograph_is_shown_in_the_report(tmp_path):
    plane_views(tmp_path / "photos")
    write_noise(tmp_path / "other", 1, (160, 160))
    (tmp_path / "other/0.png").rename(tmp_path / "photos/other.png")
    with pytest.raises(RegistrationError, match=r"(?s)too few photographs.*picture .*not_registered\.png"):
        pose_photos(tmp_path / "photos", tmp_path / "strict", min_registered_share=0.9)
    assert Image.open(tmp_path / "not_registered.png").size == (1200, 330)
    pose_photos(tmp_path / "photos", tmp_path / "scene")
    assert not (tmp_path / "not_registered.png").exists()
    views = json.loads((tmp_path / "scene/registration.json").read_text())["views"]
    assert [name for name, entry in views.items() if not entry["registered"]] == ["other.png"]
    assert views["other.png"]["belongs_near"] == []
    assert views["other.png"]["why_not"].startswith(("too few matches", "no features"))
    assert Image.open(tmp_path / "scene/registration.png").size[1] == 600 + 330


def test_views_whose_lens_cannot_be_undone_are_left_out_with_advice(tmp_path, monkeypatch):
    plane_views(tmp_path / "photos")
    bent: list[str] = []

    def map_views(*arguments):
        models = mapping.map_views(*arguments)
        for image in models[0].images.values():
            if image.name in bent:
                focal, x, y, _ = image.camera.params
                image.camera.params = [focal, x, y, -1.5]  # turns back inside the image
        return models

    monkeypatch.setattr(poses, "map_views", map_views)
    bent.append("000.png")
    pose_photos(tmp_path / "photos", tmp_path / "scene", single_camera="no")
    assert Scene.load(tmp_path / "scene").cameras.names == tuple(f"00{row}.png" for row in range(1, 5))
    report = json.loads((tmp_path / "scene/registration.json").read_text())
    assert report["views"]["000.png"]["why_not"] == "the lens distortion of view 000.png cannot be undone"
    assert report["registered"] == 4 and any("camera_model: opencv" in each for each in report["warnings"])
    with pytest.raises(RegistrationError, match=r"(?s)000\.png cannot be undone.*fix.*camera_model: opencv"):
        pose_photos(tmp_path / "photos", tmp_path / "strict", single_camera="no", min_registered_share=1.0)
    bent += [f"00{row}.png" for row in range(1, 5)]
    with pytest.raises(RegistrationError, match=r"(?s)found     0 .*linear field of view"):
        pose_photos(tmp_path / "photos", tmp_path / "none", single_camera="no")


def test_copies_of_photographs_are_left_out(tmp_path):
    photos = tmp_path / "photos"
    plane_views(photos)
    for name in ("000 copy.png", "0.png"):  # the shorter name is kept, not the first or last one
        shutil.copy(photos / "000.png", photos / name)
    pose_photos(photos, tmp_path / "scene", min_registered_share=1.0)
    report = json.loads((tmp_path / "scene/registration.json").read_text())
    assert (report["images"], report["registered"]) == (5, 5)
    lost = {view: entry["why_not"] for view, entry in report["views"].items() if not entry["registered"]}
    assert lost == {"000 copy.png": "a copy of 0.png", "000.png": "a copy of 0.png"}
    for name in ("000.png", "001.png"):
        (write_noise(tmp_path / "few", 1) / "0.png").rename(tmp_path / "few" / name)
    with pytest.raises(SceneError, match=r"too few images(.|\n)*found +1\n"):
        pose_photos(tmp_path / "few", tmp_path / "none")


@pytest.mark.parametrize(("counts", "large", "threads"), [((5, 4, 3), 100, [2]), ((7, 6, 10), 12, [1, 2])])
def test_captures_of_one_place_join_and_photographs_of_another_place_are_named(
    tmp_path, monkeypatch, counts, large, threads
):
    monkeypatch.setattr(mapping, "LARGE_CAPTURE", large)  # the second captures are large
    photos = tmp_path / "photos"
    photos.mkdir()
    turns = {}
    for capture, views, step_deg, place in zip("abc", counts, (9, 8, 9), (1, 1, 2), strict=True):
        cameras = plane_views(tmp_path / capture, views, step_deg=step_deg, place=place)
        for view in cameras.names:
            (tmp_path / capture / view).rename(photos / f"{capture}{view}")
            turns[capture + view] = cameras[view].cam_from_world[:3, :3]
    settings = PosesSettings(matcher="retrieval", min_registered_share=0.5)
    first, *others = outs = [tmp_path / f"{count} threads" for count in threads]
    for out, count in zip(outs, threads, strict=True):
        run_poses(photos, out, "w/c", "metre", True, settings, 0, count)
    report = json.loads((first / "registration.json").read_text())
    joined, other = sum(counts[:2]), counts[2]
    assert report["groups"] == report["models"] == [joined, other] and report["registered"] == joined
    warning = f"2 groups of {joined} and {other} photographs without a common point: 2 scenes?"
    assert warning in report["warnings"]
    lost = {view: entry["why_not"] for view, entry in report["views"].items() if not entry["registered"]}
    assert list(lost) == [f"c{row:03d}.png" for row in range(other)]
    assert all("another place" in why and f"group of {other} photographs" in why for why in lost.values())
    cameras = Scene.load(first).cameras
    for view in cameras.names:  # relative turns don't depend on the scene's coordinates
        found = cameras[view].cam_from_world[:3, :3] @ cameras["a000.png"].cam_from_world[:3, :3].T
        np.testing.assert_allclose(found, turns[view] @ turns["a000.png"].T, atol=0.02)
    for other, file in product(others, first.rglob("*.*")):
        assert file.read_bytes() == (other / file.relative_to(first)).read_bytes(), file


def test_photographs_of_two_places_are_reported_as_two_scenes(tmp_path):
    photos = tmp_path / "photos"
    for capture, place in (("desk", 1), ("shelf", 2)):
        for view in plane_views(tmp_path / capture, 4, place=place).names:
            photos.mkdir(exist_ok=True)
            (tmp_path / capture / view).rename(photos / f"{capture}{view}")
    write_noise(tmp_path / "other", 1, (160, 160))
    (tmp_path / "other/0.png").rename(photos / "other.png")
    with pytest.raises(RegistrationError) as caught:
        pose_photos(photos, tmp_path / "results/photos/test/scene")
    message = str(caught.value)
    assert "are 2 groups of 4 photographs without a common point: 2 scenes?" in message.splitlines()[0]
    for capture in ("desk", "shelf"):
        files = ", ".join(f"{capture}{row:03d}.png" for row in range(3))
        assert f"\n            group of 4: {files} and 1 more\n" in message
    assert message.count("other.png: ") == 1 and "hilsplat new NAME FOLDER" in message
    # a row for each group, and one for the photograph in no group
    assert Image.open(tmp_path / "results/photos/test/not_registered.png").size == (1200, 120 + 3 * 210)


def test_the_time_orders_photographs(tmp_path):
    """A burst has one time per second and a fraction; without a time, a photograph comes first."""
    moments = [("2026:05:17 12:30:59", "5"), ("2026:05:17 12:30:59", "25"), ("2026:05:17 09:00:00", None)]
    tags = [
        {"DateTimeOriginal": time, **({"SubsecTimeOriginal": part} if part else {})} for time, part in moments
    ]
    times = [exif_time(photograph(tmp_path / "a.jpg", **given)) for given in (*tags, {})]
    assert sorted(range(4), key=times.__getitem__) == [3, 2, 1, 0]


def photograph(path, size=(400, 300), orientation=1, **tags):
    """A photograph, by default with a diagonal of 500 px, with tags in its EXIF block."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base[name]: value for name, value in tags.items()})
    pillow_heif.register_heif_opener()
    Image.new("RGB", size, (90, 120, 30)).save(path, exif=exif.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".heic", ".avif", ".webp", ".png", ".tif"])
def test_the_35_mm_equivalent_is_read_from_every_format(tmp_path, suffix):
    path = photograph(tmp_path / f"a{suffix}", FocalLengthIn35mmFilm=26)
    # 26 mm on a diagonal of 43.27 mm are 26 / 43.27 of the picture's diagonal
    assert exif_focal_px(path, (300, 400)) == pytest.approx(500 * 26 / 43.2666)


def test_the_focal_length_scales_with_a_shrunk_and_rotated_picture(tmp_path):
    path = photograph(tmp_path / "a.heic", (800, 600), orientation=6, FocalLengthIn35mmFilm=26)
    (image,), _ = prepare_images([path], tmp_path / "work", max_side_px=400)
    assert image.size_hw == (400, 300) == read_image(tmp_path / "work/a.png").shape[:2]
    assert image.focal_px == pytest.approx(500 * 26 / 43.2666)


def test_several_threads_keep_the_order_of_photographs_and_name_the_damaged_ones(tmp_path):
    photos = [photograph(tmp_path / f"{row}.jpg", (40 - row, 30)) for row in range(9)]
    photos[3].write_bytes(photos[3].read_bytes()[:200])
    one, other = (prepare_images(photos, tmp_path / str(k), 800, 0.5, threads=k) for k in (1, 3))
    assert one == other and [*one[1]] == [photos[3]]
    assert [image.source for image in one[0]] == photos[:3] + photos[4:]


def test_large_photographs_are_read_by_fewer_threads(tmp_path, monkeypatch):
    photos = [photograph(tmp_path / "a.png", (10, 10)), photograph(tmp_path / "b.png", (400, 300))]
    for most_px, number in ((10**9, 4), (3 * 400 * 300 - 1, 2), (1, 1)):
        monkeypatch.setattr(images, "READ_PX", most_px)
        assert images.num_readers(photos, 16) == number and images.num_readers(photos, 1) == 1
    assert images.num_readers([tmp_path / "none.jpg"], 2) == 1


@pytest.mark.parametrize(("unit", "resolution"), [(2, 2540), (3, 1000), (4, 100), (0, 2540)])
def test_without_an_equivalent_the_sensor_resolution_is_used(tmp_path, unit, resolution):
    """100 px per mm: a lens of 5 mm is 500 px, in half the picture 250, in a tenth-size copy 50."""
    tags = {"FocalLength": IFDRational(5), "FocalPlaneXResolution": IFDRational(resolution)}
    tags["FocalPlaneResolutionUnit"] = unit
    path = photograph(tmp_path / "a.jpg", ExifImageWidth=400, **tags)
    assert exif_focal_px(path, (300, 400)) == pytest.approx(500)
    assert exif_focal_px(path, (150, 200)) == pytest.approx(250)
    shrunk = photograph(tmp_path / "a.jpg", ExifImageWidth=4000, **tags)
    assert exif_focal_px(shrunk, (300, 400)) == pytest.approx(50)


@pytest.mark.parametrize(("focal", "film"), [(IFDRational(5), 0), (IFDRational(1, 0), 0), (5, 65535), (5, 1)])
def test_without_usable_tags_there_is_no_focal_length(tmp_path, focal, film):
    path = photograph(tmp_path / "a.jpg", FocalLength=focal, FocalLengthIn35mmFilm=film)
    assert exif_focal_px(path, (300, 400)) is None


@pytest.mark.parametrize("start", ["load()", "thread = Thread(target=load); thread.start(); thread.join()"])
def test_pycolmap_does_not_replace_the_handler_of_sigterm(start):
    lines = (
        "import signal",
        "from importlib import import_module",
        "from threading import Thread",
        "signal.signal(signal.SIGTERM, lambda *_: print('handled'))",
        "load = lambda: import_module('hilsplat.scene.colmap')",
        start,
        "signal.raise_signal(signal.SIGTERM)",
    )
    printed = subprocess.check_output([sys.executable, "-c", "\n".join(lines)], text=True)
    assert printed == "handled\n"
