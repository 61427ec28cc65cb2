"""Models and devices are checked before a job begins."""

from contextlib import nullcontext

import pytest

from hilsplat.base.errors import HilsplatError, SettingsError
from hilsplat.configuration import StageSettings
from hilsplat.splat.rasterise.device import cuda_problem
from hilsplat.workflow.models import check_device, check_models, check_stages


def stages(**sections: dict) -> StageSettings:
    return StageSettings.model_validate(sections)


@pytest.mark.parametrize("section", ["gaussians", "contributions"])
def test_a_missing_device_is_refused(section):
    if cuda_problem() is None:
        pytest.skip("this machine has CUDA")
    with pytest.raises(HilsplatError, match=rf"^{section}\.device of d/s, variant v: (.|\n)*device: cuda"):
        check_device(stages(**{section: {"device": "cuda"}}), "d/s, variant v")


@pytest.mark.parametrize(
    ("section", "model", "words"),
    [
        ("masks", "models/nope", "model folder models/nope is missing"),
        ("clip", "models/nope", "model folder models/nope is missing"),
        ("masks", "models/clip-tiny", "contains a different kind of model"),
        ("clip", "models/sam-tiny", "contains a different kind of model"),
        ("clip", "hilsplat", "no readable config.json"),
        ("clip", "models/clip-vit-b-16-laion2b", "hilsplat models get clip-vit-b-16-laion2b"),
    ],
)
def test_a_model_folder_that_cannot_be_used_is_refused(section, model, words):
    with pytest.raises(HilsplatError, match=rf"^{section}\.model of d/s: (.|\n)*{words}"):
        check_models(stages(**{section: {"model": model}}), "d/s")


PAIRS = "contributions.keep is none"


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"method": {"name": "lifted"}, "autoencoder": {"code": "network"}}, "method lifted averages codes"),
        ({"contributions": {"keep": "none"}}, PAIRS),
        ({"masks": {"segmenter": "truth-perturbed", "levels": "tree"}}, "come with their levels"),
        ({"masks": {"levels": "tree"}}, ""),
        ({"contributions": {"keep": "none"}, "method": {"name": "langsplat"}}, ""),
        ({"method": {"name": "langsplat"}, "autoencoder": {"code": "network"}}, ""),
        (
            {"contributions": {"keep": "none"}, "method": {"name": "lifted"}}
            | {"semantic_tree": {"evidence": "features"}},
            PAIRS,
        ),
    ],
)
def test_settings_that_exclude_each_other_are_refused_before_the_run(sections, words):
    with pytest.raises(SettingsError, match=words) if words else nullcontext():
        check_stages(stages(**sections), "d/s, variant v")


def test_an_unused_model_and_device_auto_are_not_checked():
    check_device(stages(), "d/s")
    check_models(stages(masks={"segmenter": "graph", "model": "models/nope"}), "d/s")
