"""Queries to the server, and the files that it exports, compared with `LanguageScene`."""

import asyncio
import base64
import io
import json
import re
import shutil
import threading
import zipfile
from pathlib import Path

import av
import cv2
import jsonschema
import numpy as np
import pytest
from PIL import EpsImagePlugin, Image, ImageFile
from plyfile import PlyData
from pycocotools import mask as coco_masks
from starlette.requests import Request

import hilsplat
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.query.names import FILE
from hilsplat.splat.ply import load_ply
from hilsplat.viewer import exports
from hilsplat.viewer.app import Viewer
from hilsplat.viewer.exports import encoded_gif
from hilsplat.viewer.frames import painted
from hilsplat.viewer.saved_files import SavedFiles
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.scene_thread import SceneThread
from tests.unit.base.test_untrusted_files import png, write_eps
from tests.unit.finished_desk import SCENE
from tests.unit.many_nodes import add_nodes
from tests.unit.splat.spz_reader import decoded
from tests.unit.viewer.conftest import TOKEN, browser_of, browsing, in_steps, run_apart, wire_camera


def ask(client, text: str, **more) -> dict:
    return client.post("/api/query", json={"text": text, **more}).json()


@pytest.mark.parametrize("text", ["mug", "mug > handle", "handle", "unicorn > rim"])
@pytest.mark.parametrize("answerer", ["tree", "field"])
def test_the_server_returns_the_answers_of_the_scene(client, scene, text, answerer):
    found, hits = ask(client, text, answerer=answerer), scene.query(text, answerer=answerer, limit=24)
    assert [hit["node"] for hit in found["hits"]] == [hit.node for hit in hits]
    assert [hit["score"] for hit in found["hits"]] == pytest.approx([hit.score for hit in hits], abs=1e-4)
    assert found["doubts"] == [str(doubt) for doubt in hits[0].doubts] and found["route"] == hits[0].route
    assert [scene.views.names[number] for number in found["best_views"]] == [*hits[0].best_views]
    last = text.split(">")[-1].strip()
    np.testing.assert_allclose(found["relevancy"], scene.node_relevancy([last], answerer)[0], atol=1e-4)


def test_all_answers_are_sent(own_desk):
    add_nodes(own_desk, 100)
    asked = {"text": "unicorn", "level": "part", "threshold": 0.4}
    with browsing(ViewerScene(own_desk)) as client:
        found = client.post("/api/query", json=asked).json()["hits"]
    hits = hilsplat.open_scene(own_desk).query("unicorn", "part", threshold=0.4, limit=1000)
    assert [hit["node"] for hit in found] == [hit.node for hit in hits] and len(found) > 90


def test_requests_match_their_openapi_description(client):
    described = client.get("/openapi.json").json()
    bodies = {
        "/api/query": {"text": "mug > handle"},
        "/api/like": {"node": 0},
        "/api/export/boxes": {"groups": [{"name": "mug", "nodes": [0]}]},
        "/api/field": {"text": "mug"},
    }
    assert bodies.keys() <= described["paths"].keys()
    for path, methods in described["paths"].items():
        ((method, of),) = methods.items()
        body = bodies.get(path)
        if method == "post" and body is None:
            continue
        given = client.request(method, path.format(variant="default", number=0, node=0), json=body)
        (kind,) = of["responses"]["200"]["content"]
        found = given.headers["content-type"].replace("png", "jpeg")  # as the photograph is
        assert (given.status_code, found) == (200, kind)
        if body is not None:
            sent = of["requestBody"]["content"]["application/json"]["schema"]
            jsonschema.validate(body, {**sent, "components": described["components"]})
    schema = {"$ref": "#/components/schemas/Answer", "components": described["components"]}
    answer = client.post("/api/query", json={"text": "mug > handle"}).json()
    jsonschema.validate(answer, schema)
    assert {*answer} == {*described["components"]["schemas"]["Answer"]["properties"]}


def test_a_photograph_and_a_level_restrict_the_answers(client, scene):
    view = 2
    hits = scene.query("mug", "part", view=scene.views.names[view])
    found = ask(client, "mug", level="part", view=view)["hits"]
    assert [hit["node"] for hit in found] == [hit.node for hit in hits]
    assert client.post("/api/query", json={"text": "mug", "view": 99}).status_code == 422
    for text in ("", ">", "mug >", "x" * 10_000):
        with pytest.raises(SettingsError) as refusal:  # the command line and the page give the same message
            scene.query(text)
        for api in ("query", "field"):
            refused = client.post(f"/api/{api}", json={"text": text})
            assert (refused.status_code, refused.json()["error"]) == (422, str(refusal.value))


def test_nodes_similar_to_a_node_or_a_picture(client, scene):
    (handle,) = ask(client, "mug > handle")["hits"]
    found = client.post("/api/like", json={"node": handle["node"]}).json()
    expected = scene.like_node(handle["node"], limit=24)
    assert [hit["node"] for hit in found["hits"]] == [hit.node for hit in expected]
    assert found["relevancy"][handle["node"]] == 1
    for bad in ("", "AAAA", "?"):
        assert client.post("/api/like", json={"picture": bad}).status_code == 422


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "AVIF"])
def test_pictures_in_the_formats_of_browsers_are_read(client, scene, kind):
    held = io.BytesIO()
    Image.new("RGB", (33, 17), (0, 0, 250)).save(held, format=kind)
    sent = {"picture": base64.b64encode(held.getvalue()).decode()}
    (book,) = ask(client, "book", level="whole")["hits"]
    assert client.post("/api/like", json=sent).json()["hits"][0]["node"] == book["node"]


@pytest.mark.parametrize("size", [(28_000, 28_000), (4097, 8), (8, 4097)])
def test_a_large_picture_is_refused_before_decoding(client, monkeypatch, size):
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda *_: pytest.fail("it was decoded"))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    sent = {"picture": base64.b64encode(png(*size)).decode()}
    answer = client.post("/api/like", json=sent)
    assert answer.status_code == 422 and "4096 px" in answer.text


def test_a_picture_cannot_choose_its_decoder(client, tmp_path, monkeypatch):
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("Ghostscript ran"))
    sent = {"picture": base64.b64encode(write_eps(tmp_path / "a.png").read_bytes()).decode()}
    assert client.post("/api/like", json=sent).status_code == 422


def test_names_that_another_server_gave_are_found_and_do_not_block_naming(own_desk):
    with browsing(ViewerScene(own_desk)) as first, browsing(ViewerScene(own_desk)) as second:
        for client in (first, second):
            ask(client, "mug")  # opens the variant
        for client, node, name in ((first, 0, "my mug"), (second, 1, "my book"), (first, 2, "my lamp")):
            outline = client.get("/api/variant/default").json()
            names = {row: each["name"] for row, each in enumerate(outline["nodes"]) if each["name"]}
            assert client.get("/api/changes").json()["names"]["default"] == outline["version"]
            sent = {
                "headers": {"if-match": f'"{outline["version"]}"'},
                "json": {"names": {**names, node: name}},
            }
            assert client.put("/api/names", **sent).status_code == 200
        for client in (first, second):
            assert [hit["node"] for hit in ask(client, "my book")["hits"]] == [1]


def test_field_relevancy_of_every_gaussian(client, scene, shown):
    def field(**more) -> np.ndarray:
        sent = client.post("/api/field", json={"text": "mug", "level": "whole", **more})
        return np.frombuffer(sent.content, np.uint8)

    values = field()
    nodes = scene.tree.node_of_gaussian[:, 0]
    (mug,) = scene.query("mug", "whole")
    assert len(values) == len(nodes)
    np.testing.assert_array_equal(field(order="page"), values[shown.order])
    assert values[nodes == mug.node].mean() > values[nodes != mug.node].mean() + 50


def test_names_are_stored_and_matched_and_need_the_last_version(client, scene, desk_project):
    outline = client.get("/api/variant/default").json()
    (book,) = ask(client, "book", level="whole")["hits"]
    node = book["node"]

    def put(name: str, version: str):
        body = {"names": {node: name}}
        return client.put("/api/names", json=body, headers={"if-match": f'"{version}"'})

    kept = put("atlas <b", outline["version"])
    assert kept.status_code == 200 and kept.json()["names"] == {str(node): "atlas <b"}
    assert put("other", outline["version"]).status_code == 412
    assert put("a > b", kept.json()["version"]).status_code == 422
    assert client.put("/api/names", json={"names": {}}).status_code == 412
    found = ask(client, "ATLAS <B")
    assert [hit["node"] for hit in found["hits"]] == [node] and found["hits"][0]["name"] == "atlas <b"
    assert client.get("/api/variant/default").json()["nodes"][node]["name"] == "atlas <b"
    assert put("", kept.json()["version"]).json()["names"] == {}
    (desk_project / SCENE / FILE).unlink()


def test_a_saved_selection_has_the_gaussians_boxes_and_labels_of_its_groups(client, scene, shown, tmp_path):
    (mug,), (handle,) = scene.query("mug", "whole"), scene.query("mug > handle")
    doubt = "'mug' may be absent"
    groups = [
        {"name": "mug > hëndle", "nodes": [handle.node], "scores": [0.62], "doubts": [doubt]},
        {"name": "mug", "nodes": [mug.node]},
    ]
    sent = {"groups": groups}
    (tmp_path / "selection.ply").write_bytes(client.post("/api/export/ply", json=sent).content)
    saved, rows = load_ply(tmp_path / "selection.ply"), scene.views.gaussians_of([mug.node, handle.node])
    np.testing.assert_array_equal(saved.means, shown.gaussians.means[rows])
    np.testing.assert_array_equal(saved.sh, shown.gaussians.sh[rows])
    labelled = PlyData.read(tmp_path / "selection.ply")
    assert labelled.comments[1:] == [
        "label 1: mug > h\\xebndle",
        f"label 1, node {handle.node}: ?, score 0.6200",
        f"label 1, doubtful: {doubt}",
        "label 2: mug",
        f"label 2, node {mug.node}: ?",
    ]
    # the handle belongs to both: it is labelled as the smaller
    expected = np.where(np.isin(rows, scene.views.gaussians_of([handle.node])), 1, 2)
    np.testing.assert_array_equal(labelled["vertex"]["label"], expected)
    boxes = client.post("/api/export/boxes", json=sent).json()["boxes"]
    found = [(box["group"], box["node"]) for box in boxes]
    assert found == [("mug > hëndle", handle.node), ("mug", mug.node)]
    assert [(box["score"], box["doubts"]) for box in boxes] == [(0.62, [doubt]), (None, [])]
    wrong = {"groups": [{**groups[0], "scores": [0.62, 0.5]}]}
    assert client.post("/api/export/boxes", json=wrong).status_code == 400
    np.testing.assert_allclose(boxes[0]["corners"], handle.oriented_box.corners(), atol=1e-4)
    compressed = decoded(client.post("/api/export/spz", json=sent).content)
    assert sorted(compressed.means[:, 0]) == pytest.approx(sorted(saved.means[:, 0]), abs=1e-3)
    for kind in ("ply", "spz", "boxes", "masks"):
        missing = {"groups": [{"name": "", "nodes": [99]}]}
        assert client.post(f"/api/export/{kind}", json=missing).status_code == 422


def test_saved_masks_are_those_of_the_hits_in_every_view_and_of_every_group(client, scene):
    (mug,), (handle,) = scene.query("mug", "whole"), scene.query("mug > handle")
    named = (("handle", handle), ("mug", mug), ("cup", mug))
    groups = [{"name": name, "nodes": [hit.node]} for name, hit in named]
    groups[0] |= {"scores": [0.62], "doubts": ["it may be absent"]}
    progress, data = in_steps(client, "masks", groups=groups)
    assert progress == [(made, len(scene.views.names)) for made in range(len(scene.views.names) + 1)]
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        coco = json.loads(archive.read("coco.json"))
        assert [image["file_name"] for image in coco["images"]] == list(scene.views.names)
        assert [each["name"] for each in coco["categories"]] == ["handle", "mug", "cup"]
        assert [each["doubts"] for each in coco["categories"]] == [["it may be absent"], [], []]
        found = {(each["category_id"], each.get("score"), each["name"]) for each in coco["annotations"]}
        assert found == {(1, 0.62, ""), (2, None, ""), (3, None, "")}
        assert [each["id"] for each in coco["annotations"]] == list(range(1, 1 + 3 * len(scene.views.names)))
        for entry in coco["annotations"]:
            view, (_, hit) = scene.views.names[entry["image_id"]], named[entry["category_id"] - 1]
            png = Image.open(io.BytesIO(archive.read(f"masks/{Path(view).stem}/{entry['node']}.png")))
            np.testing.assert_array_equal(np.asarray(png.convert("L")) > 0, hit.mask(view))
            runs = entry["segmentation"]
            np.testing.assert_array_equal(coco_masks.decode(runs).astype(bool), hit.mask(view))
            assert entry["area"] == hit.mask(view).sum() and entry["bbox"] == coco_masks.toBbox(runs).tolist()


def test_queries_run_between_the_steps_of_a_file(shown):
    thread = SceneThread(shown)
    order: list[str] = []

    def steps():
        for made in range(3):
            yield made, 3
            order.append(f"step {made}")
        return b"file"

    async def both() -> None:
        parts = SavedFiles(thread, {})._stepped(file := steps(), next(file), None)
        assert await anext(parts) == b'{"made":0,"of":3}\n'
        first = asyncio.ensure_future(anext(parts))
        await asyncio.sleep(0)
        await thread.run(lambda: order.append("click"))
        assert await first == b'{"made":1,"of":3}\n'
        assert [part async for part in parts] == [b'{"made":2,"of":3}\n', b'{"bytes":4}\n', b"file"]

    run_apart(both)
    assert order == ["step 0", "click", "step 1", "step 2"]


@pytest.mark.parametrize("kind", ["scene-spz", "page"])
def test_the_scene_thread_is_free_while_gaussians_are_compressed(shown, monkeypatch, kind):
    viewer = Viewer(shown)
    monkeypatch.setattr(shown, "spz", lambda rows: viewer.thread.worker.submit(bytes, 3).result(timeout=10))
    with browser_of(viewer.app(TOKEN)) as client:
        assert b"error" not in client.post(f"/api/export/{kind}", json={}).content[:200]


def test_a_film_follows_a_path_whose_cameras_are_sent_for_its_preview(client, shown, camera):
    views = [wire_camera(camera), {**wire_camera(camera), "cam_from_world": np.eye(4).tolist()}]
    sent = {"frames": 5, "side_px": 64, "path": views}
    progress, data = in_steps(client, "film", **sent)
    with av.open(io.BytesIO(data)) as film:
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in film.decode(video=0)]
    assert progress == [(made, 5) for made in range(6)] and len(frames) == 5
    assert frames[0].shape == (36, 64, 3) and frames[0].std() > 20
    still = painted(shown.gaussians, camera.scaled((36, 64))).astype(float)
    assert np.abs(frames[0] - still).mean() < 8 < np.abs(frames[-1] - still).mean()
    cameras = client.post("/api/path", json=sent).json()
    assert len(cameras) == 5 and all(each["size_hw"] == [36, 64] for each in cameras)
    for row, pose in ((0, camera.cam_from_world), (-1, np.eye(4))):
        np.testing.assert_allclose(cameras[row]["cam_from_world"], pose, atol=1e-9)
    np.testing.assert_allclose(cameras[3]["K"], camera.scaled((36, 64)).K, atol=1e-9)
    assert len(client.post("/api/path", json={"frames": 7}).json()) == 7


def test_a_gif_around_the_scene_has_every_other_frame_in_the_requested_size(client):
    progress, data = in_steps(client, "film", frames=7, side_px=96, format="gif")
    assert progress == [(made, 4) for made in range(5)]
    gif = Image.open(io.BytesIO(data))
    durations = []
    for number in range(gif.n_frames):  # equal neighbours are one frame that lasts longer
        gif.seek(number)
        durations.append(gif.info["duration"])
    assert sum(durations) == pytest.approx(4 * 1000 / 12, abs=15) and gif.info["loop"] == 0
    assert max(gif.size) == 96


def test_a_film_on_a_full_disk_reports_the_error(client, monkeypatch):
    def full(path, frames, *more):
        yield next(iter(frames))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(exports, "encoded_gif", full)
    sent = client.post("/api/export/film", json={"frames": 6, "side_px": 64, "format": "gif"})
    assert "No space left on device" in json.loads(sent.content.splitlines()[-1])["error"]


def test_a_query_waits_for_at_most_one_crop(shown):
    thread, order = SceneThread(shown), []
    request = Request({"type": "http", "query_string": b""})

    async def ask_among_crops() -> None:
        crops = [thread.get("/", lambda *_, n=n: order.append(n), behind=True) for n in range(6)]
        tasks = [asyncio.create_task(crop.endpoint(request)) for crop in crops]
        for _ in range(3):  # until the first crop is with the thread, and the others wait for it
            await asyncio.sleep(0)
        await thread.do(request, lambda _: order.append("question"))
        await asyncio.gather(*tasks)

    held = threading.Event()
    thread.worker.submit(held.wait, 5)  # the thread is busy until all have come
    threading.Timer(0.5, held.set).start()
    run_apart(ask_among_crops)
    assert order == [0, "question", 1, 2, 3, 4, 5]


def test_a_crop_shows_the_node_and_dims_the_rest(client, scene):
    (hit,) = scene.query("mug > handle > rim")
    crop = client.get(f"/api/crop/default/{hit.node}")
    pixels = cv2.imdecode(np.frombuffer(crop.content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    yellow = (pixels[..., 0] > 180) & (pixels[..., 1] > 180) & (pixels[..., 2] < 90)
    assert yellow[70:90, 40:120].mean() > 0.8 and yellow.mean() < 0.6
    assert np.ptp(pixels[:15], axis=2).max() < 70 and 80 < pixels[:15].mean() < 150
    assert client.get("/api/crop/default/99").status_code == 422


def test_photographs_are_requested_by_number_and_gaussians_are_sent_once(client, scene, shown):
    image = Image.open(io.BytesIO(client.get("/api/photo/3").content))
    np.testing.assert_array_equal(np.asarray(image.convert("RGB")), scene.views.image(scene.views.names[3]))
    assert client.get("/api/thumb/3").headers["content-type"] == "image/jpeg"
    assert client.get("/api/photo/99").status_code == 422
    first = client.get("/api/splats/0")
    assert len(decoded(first.content)) == len(shown.gaussians)
    assert client.get("/api/splats/1").status_code == 422
    again = client.get("/api/splats/0", headers={"if-none-match": first.headers["etag"]})
    assert again.status_code == 304 and not again.content


def test_an_exported_page_sends_no_requests_and_escapes_texts(client, shown):
    evil = "mug </script><script>alert(1)</script>".replace(">", "")
    kept = {"text": "mug > handle", "level": "part", "threshold": 0.3}
    progress, data = in_steps(client, "page", asked=[kept, {"text": evil}], link="c=v3")
    pictures = len(shown.scene.cameras) + len(shown.answering("default").tree)
    assert progress == [(made, pictures) for made in range(pictures + 1)]
    page = data.decode()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page) and "http://127" not in page
    held = dict(re.findall(r'<script type="text/plain" id="(\w+)">(.*?)</script>', page, re.S))
    assert len(decoded(base64.b64decode(held["splats"]))) == len(shown.gaussians)
    data = json.loads(held["data"])
    assert [answer["text"] for answer in data["answers"]] == ["mug > handle", evil]
    assert data["asked"] == [kept, {"text": evil, "level": "auto"}]
    assert len(data["photos"]) == len(data["scene"]["views"]) and data["link"] == "c=v3"


def test_gaussians_are_shown_during_a_run_before_queries_work(desk_project, tmp_path):
    whole, growing = desk_project / SCENE, tmp_path / "photos/desk"
    later = ("clip", "autoencoder", "field.safetensors*", "models")
    shutil.copytree(whole, growing, ignore=shutil.ignore_patterns(*later))
    shutil.copytree(desk_project / "models", tmp_path / "models")
    shown = ViewerScene(growing)
    with browsing(shown) as client:
        assert client.get("/api/scene").json()["variants"] == []
        view = {**wire_camera(shown.scene.cameras[shown.scene.cameras.names[0]]), "size_hw": [8, 8]}
        assert client.post("/api/frame", json={"camera": view}).status_code == 200
        assert client.post("/api/pick", json={"camera": view, "x": 3, "y": 3}).status_code == 200
        early = client.post("/api/query", json={"text": "mug"})
        assert early.status_code == 422 and "the scene isn't finished" in early.json()["error"]
        shutil.copytree(whole / "default/clip", growing / "default/clip")
        assert client.get("/api/scene").json()["variants"] == ["default"]
        assert ask(client, "mug")["hits"]  # before there is a field
        decoded = client.post("/api/query", json={"text": "mug", "answerer": "field"})
        assert decoded.status_code == 422 and "no language field yet" in decoded.json()["error"]
        shutil.copytree(whole / "default/autoencoder", growing / "default/autoencoder")
        for part in whole.glob("default/field.safetensors*"):
            shutil.copy(part, growing / "default")
        assert ask(client, "mug", answerer="field")["hits"]


def test_a_scene_without_gaussians_is_refused(tmp_path):
    with pytest.raises(ArtifactError, match=r"scene folder .* is missing"):
        ViewerScene(tmp_path / "nothing")
    (tmp_path / "scene").mkdir()
    with pytest.raises(ArtifactError, match=r"hilsplat run .*gaussians\.ply"):
        ViewerScene(tmp_path)


def test_a_gif_keeps_the_shades_of_a_small_answer_in_grey_surroundings(tmp_path):
    grey = np.clip(np.random.default_rng(0).normal(60, 16, (160, 160, 1)), 0, 255)
    frame = np.repeat(grey, 3, axis=2)
    x, y = np.meshgrid(*[np.linspace(0, 1, 32)] * 2)
    frame[:32, :32] = np.stack([200 + 55 * y, 90 + 60 * x, 10 + 60 * x * y], axis=2)
    frame = frame.astype(np.uint8)
    list(encoded_gif(tmp_path / "still.gif", [frame]))
    kept = np.asarray(Image.open(tmp_path / "still.gif").convert("RGB"), float)[:32, :32]
    assert np.sqrt(np.square(kept - frame[:32, :32]).mean()) < 3
