"""The decoder of a three-number code as a table: cells where latents lie, finer where it bends."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from hilsplat.language.autoencoder import Autoencoder
from hilsplat.language.quadratic import compiled

CELLS = (1 / 32, 1 / 128, 1 / 512)
"""Sides of cells, in units of the latents (which lie in the unit ball); a cell that interpolates badly is
parted into those of the next size."""

TOLERANCE = 1e-3
"""Error of the relevancy from which a cell is parted, at any of its `TRIED` places."""

TRIED = np.array(
    [[0.5, 0.5, 0.5], [0.25, 0.25, 0.25], [0.75, 0.75, 0.25], [0.75, 0.25, 0.75], [0.25, 0.75, 0.75]]
)
"""Places in a cell where the table is compared with the decoder."""

PROBES = 24
"""Decoded latents that stand for texts when a cell is tried: no text answers a latent more."""

BASIS_ERROR = 5e-4
"""Decoded vectors are kept as their coordinates in as few directions as lose no more than this."""

MAX_CORNERS = 1 << 19
"""Cells are parted no further once so many corners are in use, which bounds memory and the time of a text."""

CORNERS_AT_A_TIME = 1 << 16
BASIS_SAMPLE = 4096

OFFSET = 1 << 20
"""Added to cell numbers, so that they are positive: three of them make one key."""


@dataclass(frozen=True)
class Placed:
    """Where latents lie in a grid.

    Attributes:
        cell: row of each latent's cell.
        inside: place in the cell, 0 to 1 along each axis.
    """

    cell: Int32[np.ndarray, " P"]
    inside: Float32[np.ndarray, "P 3"]

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return self.cell.nbytes + self.inside.nbytes


class LatentGrid:
    """Relevancy of latents by trilinear look-up.

    The decoder is piecewise linear but for its last division by the length. So numerator and length are
    looked up apart: the interpolation errs only where a cell holds a bend, and is exact elsewhere.

    Args:
        code: a network with d = 3.
        features: latents of the Gaussians, from which probes are taken.
        canonical: unit vectors of the generic phrases.
        scale: of the cosines.
    """

    def __init__(
        self,
        code: Autoencoder,
        features: Float32[np.ndarray, "N 3"],
        canonical: Float32[np.ndarray, "K C"],
        scale: float,
    ) -> None:
        self._code, self._canonical, self._scale = code, canonical, scale
        seen = features[np.square(features).sum(axis=1) > 0]
        chosen = seen[np.linspace(0, len(seen) - 1, PROBES).astype(int)] if len(seen) else features[:1]
        self._probes = code.decode_array(np.ascontiguousarray(chosen))
        self._corner_keys = [np.zeros(0, np.int64) for _ in CELLS]
        self._corner_rows = [np.zeros(0, np.int32) for _ in CELLS]
        self._cell_keys = [np.zeros(0, np.int64) for _ in CELLS]
        self._cell_rows = [np.zeros(0, np.int32) for _ in CELLS]
        self._cell_bad = [np.zeros(0, bool) for _ in CELLS]
        self._cells = np.zeros((0, 8), np.int32)
        self._latents = np.zeros((0, 3), np.float32)
        self._basis = np.zeros((0, code.channels), np.float32)
        self._coordinates = np.zeros((0, 0), np.float32)
        self._generic = np.zeros(0, np.float32)
        self._length = np.zeros(0, np.float32)

    @property
    def num_corners(self) -> int:
        """Latents that were decoded."""
        return len(self._latents)

    def place(self, latents: Float32[np.ndarray, "P 3"]) -> Placed:
        """Find the cells of latents, and decode the corners of new ones."""
        cell = np.zeros(len(latents), np.int32)
        inside = np.zeros((len(latents), 3), np.float32)
        left = np.arange(len(latents))
        before = len(self._latents)
        for depth, side in enumerate(CELLS):
            scaled = latents[left].astype(np.float64) / side
            corner = np.floor(scaled).astype(np.int64)
            unique, place = np.unique(_key(corner), return_inverse=True)
            rows, bad = self._rows_of(unique, depth)
            cell[left] = rows[place]
            inside[left] = scaled - corner
            left = left[bad[place]]
            if not len(left) or len(self._latents) > MAX_CORNERS:
                break
        if len(self._latents) > before:
            self._compress()
        return Placed(cell, inside)

    def table(self, text: Float32[np.ndarray, " C"]) -> Float32[np.ndarray, "n 2"]:
        """Numerator of the text's margin, and length, at every corner."""
        answer = self._coordinates @ (self._basis @ text)
        return np.stack([answer - self._generic, self._length], axis=1)

    def look_up(
        self,
        table: Float32[np.ndarray, "n 2"],
        cell: Int32[np.ndarray, " P"],
        inside: Float32[np.ndarray, "P 3"],
        out: Float32[np.ndarray, " P"],
    ) -> None:
        """Relevancy of placed latents, into `out`."""
        _look_up(table, self._cells, cell, inside, np.float32(self._scale), out)

    def _rows_of(self, keys: Int64[np.ndarray, " u"], depth: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows of cells, new ones added, and which of them are parted further."""
        new = np.setdiff1d(keys, self._cell_keys[depth], assume_unique=True)
        if len(new):
            corners = _corners(new)
            corner_keys, place = np.unique(_key(corners).reshape(-1), return_inverse=True)
            cells = self._corners_of(corner_keys, depth)[place].reshape(-1, 8).astype(np.int32)
            bad = np.zeros(len(new), bool)
            if depth + 1 < len(CELLS):
                bad = self._errors(_unkey(new), CELLS[depth], cells) > TOLERANCE
            merged = np.concatenate([self._cell_keys[depth], new])
            rows = np.concatenate(
                [self._cell_rows[depth], len(self._cells) + np.arange(len(new), dtype=np.int32)]
            )
            bads = np.concatenate([self._cell_bad[depth], bad])
            order = np.argsort(merged)
            self._cell_keys[depth] = merged[order]
            self._cell_rows[depth], self._cell_bad[depth] = rows[order].astype(np.int32), bads[order]
            self._cells = np.concatenate([self._cells, cells])
        at = np.searchsorted(self._cell_keys[depth], keys)
        return self._cell_rows[depth][at], self._cell_bad[depth][at]

    def _corners_of(self, keys: Int64[np.ndarray, " u"], depth: int) -> np.ndarray:
        """Rows of corners, new ones added (they are decoded when they are first needed)."""
        new = np.setdiff1d(keys, self._corner_keys[depth], assume_unique=True)
        if len(new):
            rows = len(self._latents) + np.arange(len(new), dtype=np.int32)
            self._latents = np.concatenate([self._latents, (_unkey(new) * CELLS[depth]).astype(np.float32)])
            merged = np.concatenate([self._corner_keys[depth], new])
            order = np.argsort(merged)
            self._corner_rows[depth] = np.concatenate([self._corner_rows[depth], rows])[order]
            self._corner_keys[depth] = merged[order]
        return self._corner_rows[depth][np.searchsorted(self._corner_keys[depth], keys)]

    def _errors(
        self, first: Int64[np.ndarray, "c 3"], side: float, cells: Int32[np.ndarray, "c 8"]
    ) -> Float32[np.ndarray, " c"]:
        """Largest error of the relevancy of any probe at the tried places of cells."""
        used, place = np.unique(cells, return_inverse=True)
        margins, lengths = self._margins(self._latents[used])
        corner = place.reshape(cells.shape)
        worst = np.zeros(len(cells), np.float32)
        for inside in TRIED:
            along = np.stack([1 - inside, inside])
            share = np.einsum("a,b,c->abc", *along.T).reshape(8).astype(np.float32)
            found = np.einsum("k,nkp->np", share, margins[corner]) / (lengths[corner] @ share)[:, None]
            exact, length = self._margins(((first + inside) * side).astype(np.float32))
            pair = (1 / (1 + np.exp(-self._scale * margin)) for margin in (found, exact / length[:, None]))
            worst = np.maximum(worst, np.abs(np.subtract(*pair)).max(axis=1))
        return worst

    def _margins(
        self, latents: Float32[np.ndarray, "n 3"]
    ) -> tuple[Float32[np.ndarray, "n p"], Float32[np.ndarray, " n"]]:
        """Numerators of the probes' margins, and lengths, by decoding."""
        margins = np.empty((len(latents), len(self._probes)), np.float32)
        lengths = np.empty(len(latents), np.float32)
        for start in range(0, len(latents), CORNERS_AT_A_TIME):
            span = slice(start, start + CORNERS_AT_A_TIME)
            raw = self._code.decode_raw_array(latents[span])
            margins[span] = raw @ self._probes.T - (raw @ self._canonical.T).max(axis=1, keepdims=True)
            lengths[span] = np.linalg.norm(raw, axis=1)
        return margins, lengths

    def _compress(self) -> None:
        """Decode all corners and keep their coordinates in few directions, exactly enough."""
        parts = [
            self._latents[start : start + CORNERS_AT_A_TIME]
            for start in range(0, len(self._latents), CORNERS_AT_A_TIME)
        ]
        some = self._latents[:: -(-len(self._latents) // BASIS_SAMPLE)]
        unit = self._code.decode_array(some).astype(np.float64)
        values, vectors = np.linalg.eigh(np.einsum("nc,nd->cd", unit, unit) / len(unit))
        lost = np.sqrt(np.maximum(np.cumsum(values), 0))  # of the smallest directions, root mean square
        keep = max(1, int((lost > BASIS_ERROR).sum()))
        self._basis = np.ascontiguousarray(vectors[:, -keep:].T, np.float32)
        generic, length, coordinates = [], [], []
        for part in parts:
            raw = self._code.decode_raw_array(part)
            generic.append((raw @ self._canonical.T).max(axis=1))
            length.append(np.linalg.norm(raw, axis=1))
            coordinates.append(raw @ self._basis.T)
        self._coordinates = np.concatenate(coordinates)
        self._generic, self._length = np.concatenate(generic), np.concatenate(length)


def _key(cells: Int64[np.ndarray, "*n 3"]) -> Int64[np.ndarray, "*n"]:
    shifted = cells + OFFSET
    return (shifted[..., 0] << 42) | (shifted[..., 1] << 21) | shifted[..., 2]


def _unkey(keys: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 3"]:
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], axis=1) - OFFSET


def _corners(keys: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 8 3"]:
    steps = np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    return _unkey(keys)[:, None] + steps


@compiled
def _look_up(table, cells, cell, inside, scale, out):
    one = np.float32(1)
    for p in range(len(cell)):
        corners = cells[cell[p]]
        x, y, z = inside[p, 0], inside[p, 1], inside[p, 2]
        margin, length = np.float32(0), np.float32(0)
        for a in range(2):
            along_x = x if a else one - x
            for b in range(2):
                along = along_x * (y if b else one - y)
                near, far = corners[4 * a + 2 * b], corners[4 * a + 2 * b + 1]
                margin += along * ((one - z) * table[near, 0] + z * table[far, 0])
                length += along * ((one - z) * table[near, 1] + z * table[far, 1])
        out[p] = one / (one + np.exp(-scale * margin / length))
