"""The scene autoencoder: shapes, loss, determinism, and which vectors it is trained on."""

import numpy as np
import pytest
import torch

from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import ArtifactError
from hilsplat.contributions.rows import Contributions
from hilsplat.field.autoencoder import mask_targets, run_autoencoder
from hilsplat.field.code import load_code, load_latents
from hilsplat.field.network_code import Autoencoder, reconstruction_loss, train_autoencoder
from hilsplat.semantic_tree.tree import SemanticTree, run_semantic_tree
from hilsplat.settings import AutoencoderSettings, SemanticTreeSettings

QUICK = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=200)


def unit_vectors(rows: int, channels: int, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(rows, channels)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_both_ends_have_unit_length():
    model = Autoencoder(16, 3)
    latents = model.encode_array(unit_vectors(5, 16))
    assert latents.shape == (5, 3)
    assert np.linalg.norm(latents, axis=1) == pytest.approx(np.ones(5), abs=1e-5)
    assert np.linalg.norm(model.decode_array(latents * 0.4), axis=1) == pytest.approx(np.ones(5), abs=1e-5)


@pytest.mark.parametrize(("channels", "first", "last"), [(16, 16, 16), (512, 256, 256)])
def test_layers_are_never_wider_than_the_input(channels, first, last):
    model = Autoencoder(channels, 3)
    assert model.encoder[0].out_features == first
    assert model.decoder[-1].in_features == last


def test_cosine_is_taken_per_vector_not_over_the_batch():
    vectors = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    # first vector right, second opposite: squared error (0 + 4) / 4, cosines 1 and -1
    decoded = torch.tensor([[1.0, 0.0], [0.0, -1.0]])
    assert reconstruction_loss(decoded, vectors, 0.5).item() == pytest.approx(1.0 + 0.5 * 1.0)


def test_a_batch_of_one_vector_trains():
    assert train_autoencoder(unit_vectors(1, 8), QUICK, seed=0).latent == 3


def test_training_recovers_a_few_vectors():
    vectors = unit_vectors(6, 16)
    settings = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=600, learning_rate=2e-3)
    model = train_autoencoder(vectors, settings, seed=0)
    decoded = model.decode_array(model.encode_array(vectors))
    assert (decoded * vectors).sum(axis=1).mean() > 0.95


def test_same_seed_same_bytes_on_any_number_of_threads(tmp_path):
    before = torch.get_num_threads()
    paths = []
    for threads, seed in ((1, 0), (2, 0), (2, 1)):
        torch.set_num_threads(threads)
        paths.append(tmp_path / f"{threads}-{seed}.safetensors")
        train_autoencoder(unit_vectors(70, 16), QUICK, seed).save(paths[-1])
        assert torch.get_num_threads() == threads
    torch.set_num_threads(before)
    one, two, other = (path.read_bytes() for path in paths)
    assert one == two
    assert one != other


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ArtifactError, match=r"autoencoder\.safetensors cannot be read"):
        load_code(tmp_path)


@pytest.fixture
def boxes_with_tree(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    tree = world.folder / "semantic_tree"
    run_semantic_tree(contributions, world.masks, world.clip, tree, SemanticTreeSettings())
    return world, contributions, tree


def test_targets_are_node_vectors_where_a_mask_fits_one(boxes_with_tree):
    _, _, folder = boxes_with_tree
    tree = SemanticTree.load(folder)
    tree.node_of_mask[3] = -1
    own = unit_vectors(len(tree.node_of_mask), 16)
    target, train = mask_targets(own, tree, "node")
    assert np.array_equal(target[3], own[3])
    assert np.array_equal(target[0], tree.clip[tree.node_of_mask[0]])
    assert len(train) == len(tree) + 1
    assert mask_targets(own, tree, "mask")[0] is own


def test_stage_encodes_every_mask(boxes_with_tree):
    world, contributions, tree = boxes_with_tree
    out = world.folder / "autoencoder"
    settings = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=600, learning_rate=2e-3)
    run_autoencoder(world.clip, tree, contributions, out, settings, 0)
    latents = load_latents(out, Contributions.load(contributions))
    assert latents.shape == (24, 3)
    index = read_index(out)
    assert index["latent"] == 3
    assert index["channels"] == 16
    assert index["decoder_cosine"] > 0.8
    # masks of one node share its code
    node = SemanticTree.load(tree).node_of_mask
    assert np.array_equal(latents[0], latents[np.flatnonzero(node == node[0])[1]])
    model = load_code(out)
    decoded = model.decode_array(latents)
    assert (decoded * SemanticTree.load(tree).clip[node]).sum(axis=1).mean() > 0.8
