"""Time to score a view: 20 annotated texts at 986 x 728 px, with precomputed relevancies and node masks."""

import time
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.goals import Goal
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import measure_view
from hilsplat.settings import EvaluateSettings

SIZE_HW = (728, 986)
VIEW = "view"
one_thread = pytest.mark.benchmark(timer=time.process_time, min_rounds=3, max_time=5)


class Answers:
    """Precomputed answers: a relevancy map per text and level, and a node per text."""

    def __init__(self, texts: list[str], regions: list[np.ndarray]) -> None:
        rng = np.random.default_rng(0)
        self.regions = dict(zip(texts, regions, strict=True))
        noise = rng.uniform(0, 0.4, (len(LEVELS), *SIZE_HW)).astype(np.float32)
        self.views, self.field = self, self
        self.maps = {text: noise + np.float32(0.6) * region for text, region in self.regions.items()}

    def relevancy(self, texts, view):
        return np.stack([self.maps[text] for text in texts])

    def cosine(self, texts, view, pixels):
        return np.stack([self.maps[text].reshape(len(LEVELS), -1)[:, pixels] for text in texts])

    node_relevancy_map = relevancy
    node_cosine = cosine

    def select(self, path, *, level=None, view=None):
        return SimpleNamespace(ids=np.array([list(self.regions).index(path[-1])]), level=level)

    def node_masks(self, view, ids):
        return list(self.regions.values())[ids[0]]


@cache
def annotated_view() -> tuple[Answers, ViewTruth]:
    """Return a view with five objects of 200 x 300 px, each with a half, a quarter and a rim."""
    regions, labelled = [], []
    for thing in range(5):
        top, left = 60 + 250 * (thing // 3), 20 + 320 * (thing % 3)
        parts = (("thing", 1, 200, 300), ("half", 2, 200, 150), ("quarter", 3, 100, 150), ("rim", 3, 40, 150))
        path: tuple[str, ...] = ()
        for name, level, height, width in parts:
            region = np.zeros(SIZE_HW, bool)
            region[top : top + height, left : left + width] = True
            text = f"{name} {thing}"
            path = (*path[: level - 1], text)
            pixels = partial(np.asarray, region)
            labelled.append(LabelledRegion(text, SIZE_HW, pixels, level=Level(level), path=path))
            regions.append(region)
    answers = Answers([region.text for region in labelled], regions)
    return answers, ViewTruth.of_regions(labelled, SIZE_HW)


@one_thread
@pytest.mark.parametrize("method", ["field", "tree", "tree-path"])
def test_scoring_a_view(benchmark, method):
    answers, truth = annotated_view()
    settings = EvaluateSettings(methods=(method,))
    selections, masks = Selections(answers), PackedMasks(SIZE_HW)
    benchmark.extra_info |= {"case": scoring(method), "count": len(truth.queries), "of": "queries"}
    assert benchmark(lambda: list(measure_view(selections, truth, VIEW, masks, settings, ExtraProtocols())))


def scoring(method: str) -> str:
    """Return the name of a case."""
    return f"scoring a view of 986x728 with 20 queries, {method}"


GOALS = [
    Goal("scoring 20 queries of the field, 986x728", "ms", 1000, lambda t: t[scoring("field")]),
    Goal("the same of the tree", "ms", 1000, lambda t: t[scoring("tree")]),
]
