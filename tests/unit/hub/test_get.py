"""Downloads from a loopback hub, and exports: models are installed completely and checked, or not at all."""

import errno
import hashlib
import io
import json
import re
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from email.utils import formatdate
from pathlib import Path
from unittest.mock import Mock

import huggingface_hub
import pytest
import requests
from huggingface_hub.utils import reset_sessions

from hilsplat.base.errors import DiskSpaceError, DownloadError, ModelError
from hilsplat.base.lineage import sha256_of_file
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.model_check import check_models
from hilsplat.hub import catalogue, get
from hilsplat.hub.catalogue import pins
from hilsplat.hub.get import get_models
from hilsplat.hub.retries import retry_after_s
from hilsplat.models.store import RELEASES, models_table, real_model
from tests.loopback_hub import Refusal, git_sha1
from tests.unit.artifact_changes import flip_bit
from tests.unit.hub.conftest import CLIP, SAM, point_at, write_pins
from tests.unit.segment.handmade import move_weights

ENCODER = "vision_encoder.onnx"
TARGET = Path("models/sam-vit-base")
STAGING = Path("models/.sam-vit-base.part")
NOWHERE = "http://127.0.0.1:9"
EXPORTED = "clip-vit-b-16-laion2b"
REPOSITORY = next(release.repository for release in RELEASES if release.name == EXPORTED)


def visible() -> list[str]:
    """Names of the non-hidden entries of `models/`."""
    return sorted(path.name for path in Path("models").glob("[!.]*"))


def refuse(message: str, *names: str, error: type[Exception] = DownloadError, **options: str) -> None:
    """Fetch models, by default a SAM, which ends with an error and without a new model."""
    before = visible()
    with pytest.raises(error, match=message):
        get_models(names or ["sam-vit-base"], **options)
    assert visible() == before


def files_of(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def origin_of(folder: Path) -> dict:
    return json.loads((folder / "origin.json").read_text())


@pytest.fixture
def changed(hub, repositories, tmp_path) -> Path:
    """A copy of the SAM repository, served as `some/changed`."""
    shutil.copytree(repositories[SAM], tmp_path / "changed")
    hub.repositories["some/changed"] = tmp_path / "changed"
    return tmp_path / "changed"


def test_without_a_name_the_recommended_pair_is_fetched_and_used(hub, repositories, caplog):
    caplog.set_level("INFO")
    hub.repositories["onnx-community/sam2.1-hiera-small-ONNX"] = repositories[SAM]
    hub.licences[CLIP] = "mit"
    target = Path("models/sam2.1-hiera-small")
    assert "sam2.1-hiera-small" in models_table() and "in use" not in models_table()
    text = get_models(())
    assert "folder     models/sam2.1-hiera-small" in text
    assert text.endswith("photographs use sam2.1-hiera-small and clip-vit-base-patch16")
    assert "0.6 MB in 4 files" in caplog.text and "GB free on the disk of models" in caplog.text
    assert "licence: Apache-2.0" in caplog.text and "licence: mit" in caplog.text  # known; from the hub
    assert visible() == ["clip-vit-base-patch16", "sam2.1-hiera-small"]
    # only what is needed: no card, no quantized copies, no complete CLIP
    networks = ["onnx/prompt_encoder_mask_decoder.onnx", "onnx/vision_encoder.onnx"]
    assert list(Path("models/.int8").glob("*.onnx"))
    assert files_of(target) == ["config.json", *networks, "origin.json", "preprocessor_config.json"]
    assert "model.onnx" not in files_of(Path("models/clip-vit-base-patch16"))
    origin, config = origin_of(target), (target / "config.json").read_bytes()
    assert origin["repository"] == "onnx-community/sam2.1-hiera-small-ONNX"
    assert origin["revision"] == hub.commit(origin["repository"])
    small, *_, large, _ = origin["files"]
    assert small == {"path": "config.json", "bytes": len(config), "git_sha1": git_sha1(config)}
    assert large["sha256"] == sha256_of_file(target / "onnx" / ENCODER)
    assert (real_model("sam"), real_model("clip")) == (target, Path("models/clip-vit-base-patch16"))
    rows = [line.split()[:6] for line in models_table().splitlines()]
    assert ["sam2.1-hiera-small", "SAM", "184", "Apache-2.0", "in", "use"] in rows
    report, num_failed = check_models()
    assert num_failed == 0 and report.count("digest") == 4  # with the embedded ones
    (target / "config.json").write_text("{")
    report, num_failed = check_models()
    assert num_failed == 1 and "models/sam2.1-hiera-small does not work" in report


def test_a_second_get_transfers_nothing_and_a_new_commit_replaces_all_but_files_of_the_user(hub, changed):
    get_models(["sam-vit-base", SAM])
    assert len(hub.ranges(ENCODER)) == 1
    hub.asked.clear()
    assert "models/sam-vit-base already exists" in get_models(["sam-vit-base"])
    assert [path for _, path, _ in hub.asked] == [f"/api/models/{SAM}"]
    for damage in (Path.unlink, lambda path: flip_bit(path, 0.5)):
        damage(TARGET / "onnx" / ENCODER)
        assert "kind       sam" in get_models(["sam-vit-base"]), "it was not fetched again"
    preprocessing = json.loads((changed / "preprocessor_config.json").read_text())
    (changed / "preprocessor_config.json").write_text(json.dumps({**preprocessing, "resample": 3}))
    (TARGET / "vocabulary.txt").write_text("mug")
    (TARGET / "onnx/mine").mkdir()
    (TARGET / "onnx/mine/drawing.png").touch()
    hub.repositories[SAM] = changed
    get_models(["sam-vit-base"])
    assert (TARGET / "vocabulary.txt").read_text() == "mug" and (TARGET / "onnx/mine/drawing.png").is_file()
    assert json.loads((TARGET / "preprocessor_config.json").read_text())["resample"] == 3
    assert origin_of(TARGET)["revision"] == hub.commit(SAM)


@pytest.mark.parametrize("ranged", [True, False])
def test_a_cut_download_is_resumed_also_from_a_mirror_that_ignores_ranges(hub, repositories, waits, ranged):
    hub.ranged = ranged
    hub.cuts[ENCODER] = [200_000, 150_000] if ranged else [200_000]
    get_models(["sam-vit-base"])
    first, *rest = hub.ranges(ENCODER)
    assert first == "" and rest and rest[0].startswith("bytes=")
    assert (TARGET / "onnx" / ENCODER).read_bytes() == (repositories[SAM] / "onnx" / ENCODER).read_bytes()


def test_a_failed_download_is_resumed(hub, waits):
    hub.cuts[ENCODER] = [300_000, *[0] * 100]
    message = r"cannot be downloaded(.|\n)*transferred data is kept(.|\n)*onnx/vision_enc"
    refuse(message)
    assert visible() == [] and "incomplete" in models_table()
    hub.cuts.clear()
    hub.asked.clear()
    get_models(["sam-vit-base"])
    (resumed,) = hub.ranges(ENCODER)
    assert 0 < int(resumed.removeprefix("bytes=").removesuffix("-")) <= 300_000
    assert visible() == ["sam-vit-base"] and not STAGING.exists()


@pytest.mark.parametrize("name", ["CACHEDIR.TAG", "config.json.metadata"])
def test_a_disk_error_while_fetching_costs_only_that_attempt(hub, monkeypatch, name):
    opening = io.open

    def failing(path, mode="r", *arguments, **options):
        if Path(path).name == name and ("w" in mode) == (name == "CACHEDIR.TAG"):
            raise OSError(errno.EIO, "Input/output error", str(path))
        return opening(path, mode, *arguments, **options)

    with monkeypatch.context() as patched, suppress(OSError):
        patched.setattr("io.open", failing)
        patched.setattr("builtins.open", failing)
        get_models(["sam-vit-base"])
    get_models(["sam-vit-base"])
    assert visible() == ["sam-vit-base"]


def test_files_with_another_digest_are_refused_and_deleted(hub, repositories):
    content = (repositories[SAM] / "onnx" / ENCODER).read_bytes()
    hub.replaced[ENCODER] = content[:-1] + bytes([content[-1] ^ 1])
    message = rf"does not have the expected digest(.|\n)*{hashlib.sha256(content).hexdigest()}"
    refuse(message)
    assert visible() == [] and not (STAGING / "onnx" / ENCODER).exists()
    hub.replaced.clear()
    get_models(["sam-vit-base"])
    assert visible() == ["sam-vit-base"]


def test_disk_and_memory_are_reported_before_the_transfer(hub, monkeypatch, caplog):
    caplog.set_level("INFO")
    monkeypatch.setattr(get.shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 100_000_000})())
    message = r"disk of models\n  expected  at least 191 MiB free\n  found     95 MiB free"
    refuse(message, error=DiskSpaceError)
    assert "needs 1 MB of disk space with its int8 networks, and about 1.6 GB of memory" in caplog.text
    assert hub.ranges(ENCODER) == []


BUSY = Refusal(429, {"Retry-After": "7200"})
TOO_MANY = r"too many requests(.|\n)*Retry-After: 7200(.|\n)*HF_TOKEN"
GATED, NO_FILE = Refusal(401, {"X-Error-Code": "GatedRepo"}), Refusal(404, {"X-Error-Code": "EntryNotFound"})
NO_LISTING = rf"sent an invalid listing of {SAM}\n  found +"


def refusing(where: str, refusal: Refusal) -> Callable:
    return lambda hub, patch: hub.refusals.update({where: [refusal] * 100})


def listing(change: Callable[[dict], object]) -> Callable:
    def fault(hub, patch):
        changed = change(hub.info(SAM))
        patch.setattr(hub, "info", lambda repository: changed)

    return fault


def silent(hub, patch):
    patch.setattr(catalogue, "TIMEOUT_S", 0.2)
    patch.setattr(hub, "info", lambda repository: threading.Event().wait(1) or {})


def behind_a_proxy(hub, patch):
    patch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    patch.setenv("NO_PROXY", "")
    reset_sessions()


def with_xet(error: Exception) -> Callable:
    def fault(hub, patch):
        patch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", False)
        patch.setattr(huggingface_hub, "hf_hub_download", Mock(side_effect=error))

    return fault


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (refusing("/api/", BUSY), TOO_MANY),
        (refusing("/resolve/", BUSY), TOO_MANY),
        (refusing("/api/", Refusal(503)), r"failed to serve Xenova/sam-vit-base \(503"),
        (refusing("/api/", GATED), r"requires you to accept(.|\n)*accept them at http"),
        (refusing("/api/", Refusal(403)), r"denies access to Xenova/sam-vit-base \(403"),
        (refusing("/api/", NO_FILE), r"does not have this revision or file"),
        (lambda hub, _: hub.truncated.update({ENCODER: 1000}), r"announced length(.|\n)*truncates files"),
        (silent, r"ReadTimeout, http\S+ is unreachable"),
        (listing(lambda info: b"<html>sign in</html>"), f"{NO_LISTING}JSONDecodeError"),
        (listing(lambda info: b"[1]"), f"{NO_LISTING}TypeError"),
        (listing(lambda info: {**info, "siblings": [3]}), f"{NO_LISTING}(Attribute|Type)Error"),
        (listing(lambda info: {**info, "siblings": [{"size": 3}]}), f"{NO_LISTING}KeyError"),
        (with_xet(RuntimeError("Data processing error: CAS service error")), "unset HF_HUB_DISABLE"),
        (with_xet(ValueError("Failed to refresh token")), "unset HF_HUB_DISABLE"),
        (with_xet(RuntimeError("IO Error: No space left on device (os error 28)")), "no space left while"),
        (with_xet(OSError(errno.ENOSPC, "No space left on device", "config.json")), "no space left while"),
        (behind_a_proxy, r"the proxy does not connect to http(.|\n)*correct HTTPS_PROXY"),
        (
            lambda _, patch: point_at(NOWHERE, patch),
            rf"{NOWHERE}/Xenova\S+ is unreach(.|\n)*refused(.|\n)*PROXY",
        ),
    ],
)
def test_faults_of_the_transfer_are_named_with_a_fix(hub, monkeypatch, waits, fault, message):
    fault(hub, monkeypatch)
    refuse(message, error=DiskSpaceError if "space" in message else DownloadError)


def test_an_untrusted_certificate_is_named_at_once(hub, monkeypatch, waits):
    error = requests.exceptions.SSLError("certificate verify failed: self-signed certificate")
    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", Mock(side_effect=error))
    refuse(r"no trusted certificate from http(.|\n)*REQUESTS_CA_BUNDLE")
    assert waits == []


@pytest.mark.parametrize("where", ["/api/", f"/resolve/{'{}'}/config.json", f"/lfs/{SAM}"])
@pytest.mark.parametrize(
    ("refusal", "least_s"),
    [(Refusal(429, {"Retry-After": "7"}), 7), (Refusal(429), 1), (Refusal(503), 1), (Refusal(500), 1)],
)
def test_busy_hubs_are_asked_again_after_the_time_that_they_state(hub, waits, where, refusal, least_s):
    hub.refusals[where.format(hub.commit(SAM))] = [refusal, refusal]
    assert "kind       sam" in get_models(["sam-vit-base"])
    assert max(waits) >= least_s


def test_a_date_in_retry_after_is_a_time_from_now():
    response = requests.Response()
    response.headers["Retry-After"] = formatdate(time.time() + 3600, usegmt=True)
    assert 1800 < retry_after_s(response) <= 3600
    for text in ("soon", "9" * 5000, "Mon, 30 Nov 99999 00:00:00 GMT"):
        response.headers["Retry-After"] = text
        assert retry_after_s(response) == 0


def test_escape_sequences_of_the_hub_do_not_reach_the_terminal(hub, caplog):
    caplog.set_level("INFO")
    hub.licences[SAM] = "mit\x1b]0;title\x07"
    get_models(["sam-vit-base"])
    assert "licence: mit]0;title" in caplog.text and "\x1b" not in caplog.text


def test_a_released_model_is_fetched_at_its_pinned_commit_and_with_its_digests(hub, repositories, tmp_path):
    path, commit = f"onnx/{ENCODER}", "44dd3b8c825d2daa581102f162d0ebc23bbf4eea"
    digest = sha256_of_file(repositories[SAM] / path)
    write_pins(tmp_path / "pins.tsv", (SAM, commit, path, digest))
    refuse(r"does not have this revision(.|\n)*--revision main is")
    get_models(["sam-vit-base"], revision="main")
    shutil.rmtree(TARGET)
    hub.commits[SAM] = commit
    get_models(["sam-vit-base"])
    assert origin_of(TARGET)["revision"] == commit
    shutil.rmtree(TARGET)
    write_pins(tmp_path / "pins.tsv", (SAM, commit, path, "0" * 64))
    message = rf"{ENCODER} of {SAM} does not have the expected digest\n  expected  digest 0{{64}}"
    refuse(message)


def test_a_mirror_with_another_commit_than_the_pinned_one_is_refused(hub, monkeypatch, tmp_path):
    write_pins(tmp_path / "pins.tsv", (SAM, "0" * 40, "", ""))
    monkeypatch.setattr(hub, "is_lenient", True)
    refuse(rf"the pinned commit of {SAM}\n  expected  0{{40}}")
    assert "kind       sam" in get_models(["sam-vit-base"], revision="main")


def test_the_table_of_pins_covers_every_release_with_complete_hashes():
    found = pins.__wrapped__()
    assert set(found) == {release.repository for release in RELEASES}
    for pin in found.values():
        assert re.fullmatch("[0-9a-f]{40}", pin.commit)
        assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in pin.sha256.values())


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["sam-vit"], {}, r"unknown model 'sam-vit'(.|\n)*sam-vit-base"),
        (["a b/c"], {}, "'a b/c' is not a repository name"),
        (["some/thing"], {}, "the hub has no repository some/thing"),
        (["sam-vit-base"], {"revision": "v9"}, r"does not have this revision or file(.|\n)*revision/v9"),
        ([], {"revision": "main"}, "--revision requires one model, found 0"),
        (["sam-vit-base"], {"variant": "fp16"}, r"lacks onnx/vision_encoder_fp16.onnx"),
    ],
)
def test_unknown_names_revisions_and_variants_are_refused(hub, names, options, message):
    with pytest.raises(DownloadError, match=message):
        get_models(names, **options)
    assert visible() == []


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        (f"onnx/{ENCODER}", None, DownloadError, r"some/changed lacks onnx/vision_encoder.onnx"),
        ("config.json", b'{"model_type": "bert"}', DownloadError, r"no supported model(.|\n)*'bert'"),
        (f"onnx/{ENCODER}", b"no network", ModelError, r"vision_encoder.onnx cannot be opened"),
    ],
)
def test_repositories_without_a_working_model_are_refused(changed, name, content, error, message):
    (changed / name).unlink()
    if content is not None:
        (changed / name).write_bytes(content)
    refuse(message, "some/changed", error=error)


def test_a_variant_has_the_plain_names_and_external_weights_their_own(changed):
    plain, quantized = (f"onnx/prompt_encoder_mask_decoder{ending}.onnx" for ending in ("", "_quantized"))
    move_weights(changed / quantized, f"{Path(quantized).name}_data")
    move_weights(changed / plain, "Constant_62_attr__value")
    get_models(["some/changed"])
    get_models(["some/changed"], variant="quantized")
    assert visible() == ["changed", "changed-quantized"]
    assert "onnx/Constant_62_attr__value" in files_of(Path("models/changed"))
    files = files_of(Path("models/changed-quantized"))
    assert {plain, f"{quantized}_data"} <= set(files) and quantized not in files


FOREIGN = r"already exists and was not downloaded from Xenova/"


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        (TARGET / "mine.onnx", "mine", FOREIGN),
        (TARGET / "origin.json", "[]", FOREIGN),
        (TARGET / "origin.json", "{", FOREIGN),
        (TARGET / "origin.json", f'{{"repository": "{SAM}", "holds": []}}', FOREIGN),
        (STAGING / "mine", "mine", r"\.part exists, but is not a download(.|\n)*remove it"),
    ],
)
def test_folders_of_the_user_are_not_used(hub, path, content, message):
    path.parent.mkdir(parents=True)
    path.write_text(content)
    refuse(message)
    assert path.read_text() == content and [*path.parent.iterdir()] == [path]


def test_a_whole_clip_is_split(hub, clip_parts):
    hub.repositories["some/whole"] = clip_parts[2]
    get_models(["some/whole"])
    files = files_of(Path("models/whole"))
    assert {"vision_model.onnx", "text_model.onnx"} <= set(files) and "model.onnx" not in files


@pytest.mark.parametrize("name", ["_data/../../../../escaped", "_data\\..\\escaped", "_data/C:/escaped"])
def test_a_hub_cannot_write_outside_the_model(hub, monkeypatch, name):
    info, name = hub.info(SAM), f"onnx/{ENCODER}{name}"
    info["siblings"].append({"rfilename": name, "size": 1, "blobId": git_sha1(b"x")})
    monkeypatch.setattr(hub, "info", lambda repository: info)
    get_models(["sam-vit-base"])
    assert visible() == ["sam-vit-base"] and not any("escaped" in path for _, path, _ in hub.asked)


def set_offline(monkeypatch) -> None:
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    reset_sessions()


@pytest.mark.parametrize(("variant", "ending"), [("", ""), ("fp16", "_fp16")])
def test_offline_the_error_lists_the_files_to_copy(hub, monkeypatch, variant, ending):
    set_offline(monkeypatch)
    files = f"config.json, preprocessor_config.json, tokenizer.json, onnx/vision_model{ending}.onnx"
    message = (
        rf"HF_HUB_OFFLINE is set(.|\n)*into models/clip-vit-base-patch16{ending.replace('_', '-')}: {files}"
    )
    refuse(message, "clip-vit-base-patch16", variant=variant)
    assert hub.asked == []


def test_offline_models_are_read_from_the_hubs_cache_at_the_pinned_commit(hub, monkeypatch, tmp_path):
    huggingface_hub.snapshot_download(CLIP, cache_dir=tmp_path / "cache")
    hub.asked.clear()
    set_offline(monkeypatch)
    write_pins(tmp_path / "pins.tsv", (CLIP, "0" * 40, "", ""))
    message = rf"another commit of {CLIP}(.|\n)*found     {hub.commit(CLIP)}(.|\n)*patch16 --revision main"
    refuse(message, "clip-vit-base-patch16")
    assert "kind       clip" in get_models(["clip-vit-base-patch16"], revision="main")
    assert hub.asked == []
    assert origin_of(Path("models/clip-vit-base-patch16"))["revision"] == hub.commit(CLIP)


def test_exported_weights_give_the_vectors_of_transformers(hub, clip_parts):
    import torch

    model, processor, exported = clip_parts
    hub.repositories[REPOSITORY] = exported.parent / "torch"
    get_models([EXPORTED])
    folder = Path("models") / EXPORTED
    origin = origin_of(folder)
    assert origin["repository"] == REPOSITORY and "optimum-onnx" in origin["exported"]
    assert "model.safetensors" in [entry["path"] for entry in origin["files"]]
    assert not {"model.onnx", "model.safetensors"} & set(files_of(folder))
    assert sorted(path.name for path in Path("models").iterdir() if path.is_dir()) == [".int8", EXPORTED]
    inputs = processor.tokenizer(["red mug"], return_tensors="pt")
    with torch.no_grad():
        (expected,) = model.get_text_features(**inputs).numpy()
    (found,) = ClipModel.load(folder).embed_texts(["red mug"])
    # both to unit length; float32 through two runtimes
    assert abs(found - expected / (expected**2).sum() ** 0.5).max() < 1e-4


def test_weights_that_cannot_be_exported_show_the_exporter_s_last_lines(tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "clip"}')
    with pytest.raises(ModelError, match=r"the exporter exited with 1(.|\n)*Error(.|\n)*pip install"):
        get.export_networks(tmp_path, tmp_path / "out")


def test_without_the_extra_nothing_is_fetched_and_the_error_gives_the_command(hub, clip_parts, monkeypatch):
    hub.repositories[REPOSITORY] = clip_parts[2].parent / "torch"
    monkeypatch.setattr(get, "NEEDED", (*get.NEEDED, "no-such-exporter"))
    with pytest.raises(ModelError, match=r"no no-such-exporter\n  fix +pip install .* '\.\[export\]'"):
        get_models([EXPORTED])
    assert not hub.ranges("model.safetensors")
