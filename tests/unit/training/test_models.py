"""The committed small models: files, training seeds and quality as in their cards."""

import numpy as np
import pytest

from hilsplat.base.artifacts import read_json
from hilsplat.base.levels import LEVELS
from hilsplat.embed.clip import ClipModel
from hilsplat.segment.sam import SamModel, enlarged
from hilsplat_world.objects.catalogue import GENERATOR_VERSION
from hilsplat_world.render import label_view, render_view
from hilsplat_world.scenes.kinds import TRAINING_SEEDS
from models.training.cameras import training_camera
from models.training.card import CARD, RECORD, digests
from models.training.crops import list_crops
from models.training.data import LabelledViews
from models.training.measure_sam import draw_regions
from models.training.render import phrases_of, scene_of_seed
from models.training.sam import FRAME_PX, HEADS
from tests.conftest import PROJECT
from tests.unit.segment.handmade import quantise

MODELS = PROJECT / "models"


@pytest.mark.parametrize("name", ["sam-tiny", "clip-tiny"])
def test_files_have_the_digests_of_the_card_and_were_trained_on_scenes_of_this_generator(name):
    folder = MODELS / name
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 15 * 2**20
    record = read_json(folder / RECORD)
    assert digests(folder) == record["sha256"]
    card = (folder / CARD).read_text(encoding="utf-8")
    assert all(digest in card for digest in record["sha256"].values())
    recipe = record["recipe"]
    assert recipe["generator"].split("-")[0] == str(GENERATOR_VERSION)
    for seed in (*recipe["training_seeds"], *recipe["validation_seeds"]):
        assert seed in TRAINING_SEEDS
    assert recipe["training_seeds"][1] < recipe["validation_seeds"][0]


@pytest.fixture(scope="module")
def unseen() -> LabelledViews:
    """Views of four validation scenes, fewer than the cards were measured on."""
    _, last = read_json(MODELS / "sam-tiny" / RECORD)["recipe"]["validation_seeds"]
    images, labels, nodes = [], [], []
    for seed in range(last - 3, last + 1):
        scene = scene_of_seed(seed)
        camera = training_camera(scene, np.random.default_rng((seed, 12)), FRAME_PX)
        images.append(render_view(scene, camera, 1))
        labels.append(label_view(scene, camera).astype(np.int16))
        nodes.append(phrases_of(scene.nodes))
    return LabelledViews(np.stack(images), np.stack(labels), tuple(nodes))


def test_the_committed_segmenter_is_as_good_as_its_card_says(unseen):
    folder = MODELS / "sam-tiny"
    model = SamModel.load(folder)
    card = read_json(folder / RECORD)["metrics"]["points"]["all"]
    found = {level.label: [] for level in LEVELS}
    for view in range(len(unseen)):
        drawn = draw_regions(np.random.default_rng(view), unseen.labels[view], per_level=8)
        encoded = model.encode(unseen.images[view])
        _, logits = model.decode(encoded, np.array([(x, y) for _, _, x, y in drawn]))
        for row, (head, node, _, _) in enumerate(drawn):
            level = HEADS[head]
            truth = unseen.labels[view][level.index] == node
            (guess,) = enlarged(quantise(logits[row, head])[None].astype(np.float32), encoded.frame)
            found[level.label].append((truth & guess).sum() / (truth | guess).sum())
    for level, values in found.items():
        # about thirty regions with a spread of 0.3 each: three standard errors are 0.16
        assert np.mean(values) > card[level]["iou"] - 0.17


def test_the_committed_clip_is_as_good_as_its_card_says(unseen):
    folder = MODELS / "clip-tiny"
    model, crops = ClipModel.load(folder), list_crops(unseen)
    texts = sorted({phrases[0] for phrases in crops.phrase_sets})
    found = model.embed_crops(np.stack([crops.cut(row) for row in range(len(crops))]))
    best = (found @ model.embed_texts(texts).T).argmax(axis=1)
    true_texts = [crops.phrase_sets[caption][0] for caption in crops.caption]
    right = np.array([texts[row] == true_text for row, true_text in zip(best, true_texts, strict=True)])
    card = read_json(folder / RECORD)["metrics"]["black"]["exact"]
    for level in LEVELS:
        of_level = right[crops.level == int(level)]
        # there are fewer candidate texts than in the card; the standard error of twenty crops is 0.1
        assert of_level.mean() > card[level.label]["top1"] - 0.25
