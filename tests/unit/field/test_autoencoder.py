"""The scene autoencoder against torch, its determinism, and the vectors that it is trained on."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn

from hilsplat.base.artifacts import read_index, read_npy, write_npy
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.contributions.rows import Contributions
from hilsplat.embed.vectors import mask_embeddings
from hilsplat.field import autoencoder as training
from hilsplat.field import code as codes
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import AutoencoderSettings, SemanticTreeSettings
from tests.unit.artifact_changes import change_index
from tests.unit.two_boxes_world import build_contributions, reverse_masks

QUICK = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=200)


def unit_vectors(rows: int, channels: int, seed: int = 0) -> np.ndarray:
    return codes.unit_rows(np.random.default_rng(seed).normal(size=(rows, channels)).astype(np.float32))


def torch_layers(widths: list[int], norm: bool) -> nn.Sequential:
    layers = [nn.Linear(*widths[:2])]
    for before, after in pairwise(widths[1:]):
        if norm:
            layers.append(nn.BatchNorm1d(before))
        layers += [nn.ReLU(), nn.Linear(before, after)]
    return nn.Sequential(*layers)


class TorchAutoencoder(nn.Module):
    """The same network in torch, the reference for gradients and BatchNorm."""

    def __init__(self, arrays: dict[str, np.ndarray], channels: int, latent: int) -> None:
        super().__init__()
        inner = [min(width, channels) for width in (256, 128, 64, 32)]
        outer = [min(width, channels) for width in (16, 32, 64, 128, 256, 256)]
        self.encoder = torch_layers([channels, *inner, latent], norm=True)
        self.decoder = torch_layers([latent, *outer, channels], norm=False)
        self.load_state_dict({name: torch.from_numpy(arrays[name]) for name in arrays}, strict=False)

    def forward(self, vectors):
        latents = nn.functional.normalize(self.encoder(vectors), dim=-1)
        return nn.functional.normalize(self.decoder(latents), dim=-1)


def torch_loss(model: TorchAutoencoder, vectors: np.ndarray, cosine_weight: float) -> torch.Tensor:
    given = torch.from_numpy(vectors).double()
    decoded = model.double()(given)
    cosine = nn.functional.cosine_similarity(decoded, given, dim=1)  # per vector, not over the batch
    return (decoded - given).square().mean() + cosine_weight * (1 - cosine).mean()


def without_statistics(model: codes.Autoencoder) -> dict[str, np.ndarray]:
    return {name: values for name, values in model.arrays.items() if "running" not in name}


@pytest.mark.parametrize("channels", [16, 300])
def test_gradients_are_those_of_autograd(channels):
    vectors, weight = unit_vectors(24, channels), 0.3
    parameters = without_statistics(codes.Autoencoder.initial(channels, 3, np.random.RandomState(1)))
    found = {name: np.full_like(values, np.nan) for name, values in parameters.items()}
    training.loss_gradients(parameters, vectors, 3, weight, found)
    model = TorchAutoencoder(parameters, channels, 3)
    torch_loss(model, vectors, weight).backward()
    expected = {name: values.grad.numpy() for name, values in model.named_parameters()}
    assert found.keys() == expected.keys()
    largest = max(np.abs(values).max() for values in expected.values())
    for name, values in expected.items():
        bounds = np.maximum(1e-3 * np.abs(values), 2e-6 * largest)
        assert (np.abs(found[name] - values) <= bounds).all(), name


def test_a_trained_network_equals_torch_with_the_statistics_of_all_vectors():
    vectors = unit_vectors(50, 16)
    model = codes.Autoencoder.initial(16, 3, np.random.RandomState(2))
    model.arrays |= training.statistics(without_statistics(model), vectors, 3)
    reference = TorchAutoencoder(model.arrays, 16, 3)
    for module in reference.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.reset_running_stats()
            module.momentum = None  # a plain average, of one pass over all vectors
    given = torch.from_numpy(vectors).double()
    reference.double().train()(given)
    with torch.no_grad():
        expected = reference.eval()(given).numpy()
    assert model.decode_array(model.encode_array(vectors)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("rows", "widths"), [(1, (3, 1)), (130, (4, 5, 16, 7)), (64, (16, 64))])
def test_compiled_layers_equal_matrix_products_with_relu(rows, widths):
    random = np.random.default_rng(0)
    layers = [
        (random.normal(size=(out, into)).astype(np.float32), random.normal(size=out).astype(np.float32))
        for into, out in pairwise(widths)
    ]
    values = given = random.normal(size=(rows, widths[0])).astype(np.float32)
    for weight, bias in layers:
        before = values @ weight.T.astype(np.float64) + bias
        values = np.maximum(before, 0)
    expected = before / np.linalg.norm(before, axis=1, keepdims=True)
    packed = codes.PackedLayers.of(layers)
    assert packed.through(given) == pytest.approx(expected, abs=2e-6)
    assert np.array_equal(packed.through(given)[rows // 2 :], packed.through(given[rows // 2 :]))


@pytest.mark.parametrize("latent", [1, 2, 3])
def test_pieces_decode_what_the_network_decodes(latent):
    random, code = np.random.default_rng(0), codes.Autoencoder.initial(40, latent, np.random.RandomState(0))
    centres = random.normal(size=(12, latent)).astype(np.float32)
    near = random.normal(scale=1e-3, size=(1500, latent)).astype(np.float32)
    latents = np.concatenate([centres[random.integers(0, 12, 1500)] + near, near * 1e3])
    one_by_one = np.concatenate([code.decode_array(latents[row : row + 1]) for row in range(len(latents))])
    decoded = code.decode_array(latents)
    assert np.abs(decoded - one_by_one).max() <= 1e-6
    by_network = (decoded == one_by_one).all(axis=1)  # pieces round differently
    assert by_network.any()
    assert by_network[:1500].mean() < 0.1


def test_missing_files_and_weights_are_reported(tmp_path):
    with pytest.raises(ArtifactError, match=r"autoencoder\.safetensors cannot be read"):
        codes.load_code(tmp_path)
    model = codes.Autoencoder.initial(16, 3, np.random.RandomState(0))
    del model.arrays["encoder.4.running_var"]
    model.save(codes.autoencoder_file(tmp_path))
    with pytest.raises(ArtifactError, match=r"encoder.4.running_var of shape \(16,\) is missing"):
        codes.load_code(tmp_path)


def test_training_takes_the_steps_of_torch_from_its_initial_weights():
    vectors = unit_vectors(100, 16)
    settings = AutoencoderSettings(
        code="network", latent=3, epochs=20, min_steps=1, batch=32, learning_rate=2e-3
    )
    torch.manual_seed(5)
    reference = TorchAutoencoder({}, 16, 3).double()
    optimiser = torch.optim.Adam(reference.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 60)
    for _ in range(20):
        order = torch.randperm(100).numpy()
        for begin in (0, 32, 64):
            optimiser.zero_grad()
            torch_loss(reference, vectors[order[begin : begin + 32]], settings.cosine_weight).backward()
            optimiser.step()
            schedule.step()
    trained = training.train_autoencoder(vectors, settings, seed=5).arrays
    for name, values in reference.named_parameters():
        assert np.abs(trained[name] - values.detach().numpy()).max() <= 2e-4, name


@pytest.mark.parametrize("rows", [1, 70])  # one vector is enough
def test_same_seed_same_bytes(tmp_path, rows):
    written = []
    for seed in (0, 0, 1):
        path = codes.autoencoder_file(tmp_path)
        training.train_autoencoder(unit_vectors(rows, 16), QUICK, seed).save(path)
        written.append(path.read_bytes())
    assert written[0] == written[1] != written[2]


@pytest.fixture
def boxes_with_tree(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    tree = world.folder / "semantic_tree"
    run_semantic_tree(contributions, world.masks, tree, SemanticTreeSettings())
    return world, contributions, tree


def test_targets_are_the_vectors_of_nodes_or_of_masks(boxes_with_tree, monkeypatch):
    world, contributions, folder = boxes_with_tree
    tree, out = SemanticTree.load(folder, world.clip), world.folder / "autoencoder"
    tree.node_of_mask[3] = -1  # shares no Gaussian with a node
    monkeypatch.setattr(SemanticTree, "load", lambda *folders: tree)
    of_nodes = tree.clip[tree.node_of_mask]
    of_nodes[3] = tree.clip.mean(axis=0)
    for targets, expected in (("node", of_nodes), ("mask", mask_embeddings(world.clip, contributions))):
        settings = AutoencoderSettings(latent=2, targets=targets)
        training.run_autoencoder(world.clip, folder, contributions, out, settings, 0)
        latents = codes.load_latents(out, Contributions.load(contributions))
        np.testing.assert_allclose(latents, codes.load_code(out).encode_array(expected), atol=1e-6)


def test_targets_of_masks_without_vectors_are_refused(boxes_with_tree):
    world, contributions, tree = boxes_with_tree
    own = read_npy(world.clip / "001.png.npy")
    own[2] = 0
    write_npy(world.clip / "001.png.npy", own)
    change_index(world.clip)
    inputs = world.clip, tree, contributions, world.folder / "autoencoder"
    own_vectors = AutoencoderSettings(latent=2, targets="mask")
    with pytest.raises(ArtifactError, match=r"1 of 24 masks have no (.|\n)*set clip\.crops to masks"):
        training.run_autoencoder(*inputs, own_vectors, 0)
    training.run_autoencoder(*inputs, AutoencoderSettings(latent=2), 0)


def test_a_tree_of_masks_in_another_order_is_refused(boxes_with_tree):
    world, _, tree = boxes_with_tree
    reverse_masks(world, "003.png")
    contributions = build_contributions(world)
    with pytest.raises(
        MisalignedArtifactError, match=rf"{tree} was not made from the masks of view 003\.png"
    ):
        training.run_autoencoder(
            world.clip, tree, contributions, world.folder / "out", AutoencoderSettings(), 0
        )


def test_stage_encodes_every_mask(boxes_with_tree):
    world, contributions, tree = boxes_with_tree
    out = world.folder / "autoencoder"
    settings = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=600, learning_rate=2e-3)
    training.run_autoencoder(world.clip, tree, contributions, out, settings, 0)
    latents = codes.load_latents(out, Contributions.load(contributions))
    assert latents.shape == (24, 3)
    index = read_index(out)
    assert index["latent"] == 3
    assert index["channels"] == 16
    assert index["decoder_cosine"] > 0.8
    # masks of one node share its code; with some BLAS libraries, a row's last bits depend on its place
    node = SemanticTree.load(tree).node_of_mask
    np.testing.assert_allclose(latents[0], latents[np.flatnonzero(node == node[0])[1]], atol=1e-6)
    model = codes.load_code(out)
    decoded = model.decode_array(latents)
    assert (decoded * SemanticTree.load(tree, world.clip).clip[node]).sum(axis=1).mean() > 0.8


def test_a_code_of_other_masks_of_the_scene_is_reused(boxes_with_tree):
    world, contributions, tree = boxes_with_tree
    first, second = world.folder / "first", world.folder / "second"
    inputs = world.clip, tree, contributions
    settings = QUICK.model_copy(update={"targets": "mask"})
    training.run_autoencoder(*inputs, first, settings, 0)
    training.run_autoencoder(*inputs, second, settings, 1, first)
    assert codes.autoencoder_file(first).read_bytes() == codes.autoencoder_file(second).read_bytes()
    masks = Contributions.load(contributions)
    assert np.array_equal(codes.load_latents(first, masks), codes.load_latents(second, masks))
    with pytest.raises(ArtifactError, match=r"does not fit the vectors(.|\n)*codes of 4(.|\n)*16 and 3"):
        training.run_autoencoder(*inputs, second, settings.model_copy(update={"latent": 4}), 0, first)
