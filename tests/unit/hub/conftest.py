"""A loopback hub with a small SAM and a small CLIP, and `huggingface_hub` pointed at it."""

from collections.abc import Iterator
from pathlib import Path

import huggingface_hub
import onnx
import pytest
from huggingface_hub import file_download
from huggingface_hub.utils import reset_sessions

from hilsplat.hub import retries
from hilsplat.hub.catalogue import pins
from tests.loopback_hub import LoopbackHub, loopback_hub
from tests.unit.export.conftest import clip_parts, transformers
from tests.unit.finished_desk import write_colour_clip
from tests.unit.segment.handmade import write_disc_sam

__all__ = ["clip_parts", "transformers"]

SAM, CLIP = "Xenova/sam-vit-base", "Xenova/clip-vit-base-patch16"


@pytest.fixture(scope="session")
def repositories(tmp_path_factory) -> dict[str, Path]:
    """Repositories of the two models, with a card and a second set of networks."""
    folder = tmp_path_factory.mktemp("hub")
    sam = write_disc_sam(folder / "sam")
    encoder = onnx.load(sam / "onnx/vision_encoder.onnx")
    encoder.doc_string = "padding" * 90_000
    onnx.save(encoder, sam / "onnx/vision_encoder.onnx")
    for name in ("vision_encoder", "prompt_encoder_mask_decoder"):
        content = (sam / f"onnx/{name}.onnx").read_bytes()
        (sam / f"onnx/{name}_quantized.onnx").write_bytes(content)
    (sam / "README.md").write_text("card")
    write_colour_clip(folder / "clip")
    (folder / "clip/model.onnx").write_bytes(b"both halves, which are not needed")
    return {SAM: sam, CLIP: folder / "clip"}


def point_at(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the endpoint as HF_ENDPOINT does when the library is first imported."""
    monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", endpoint)
    template = endpoint + "/{repo_id}/resolve/{revision}/{filename}"
    for module in (huggingface_hub.constants, file_download):
        monkeypatch.setattr(module, "HUGGINGFACE_CO_URL_TEMPLATE", template)


@pytest.fixture
def hub(repositories, monkeypatch, tmp_path) -> Iterator[LoopbackHub]:
    """The hub; the working directory is an empty project."""
    with loopback_hub() as served:
        served.repositories.update(repositories)
        point_at(served.endpoint, monkeypatch)
        monkeypatch.setattr("hilsplat.hub.catalogue.PINS", write_pins(tmp_path / "pins.tsv"))
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(huggingface_hub.constants, "DOWNLOAD_CHUNK_SIZE", 2**16)
        monkeypatch.setenv("HF_TOKEN", "hf_of_the_user")
        monkeypatch.delenv("HTTP_PROXY", raising=False)
        monkeypatch.delenv("http_proxy", raising=False)
        (tmp_path / "project").mkdir()
        monkeypatch.chdir(tmp_path / "project")
        reset_sessions()
        yield served
        reset_sessions()
    pins.cache_clear()


@pytest.fixture
def waits(monkeypatch) -> list[float]:
    """Waiting times, in seconds, which are skipped."""
    seconds: list[float] = []
    monkeypatch.setattr(retries.time, "sleep", seconds.append)
    return seconds


def write_pins(path: Path, *rows: tuple[str, str, str, str]) -> Path:
    """Write a table of pinned commits and digests, by default an empty one."""
    lines = [("repository", "commit", "path", "sha256"), *rows]
    path.write_text("".join("\t".join(line) + "\n" for line in lines))
    pins.cache_clear()
    return path
