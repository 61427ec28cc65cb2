"""Groups of Gaussians, and the code of a group from the masks that show it."""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float32, Int32, Int64

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import NONE
from hilsplat.contributions.rows import Contributions
from hilsplat.settings import MethodSettings

Closeness = Callable[[Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]], Float[np.ndarray, " k"]]


def group_latents(
    group: Int32[np.ndarray, " N"] | Int64[np.ndarray, " N"],
    num_groups: int,
    contributions: Contributions,
    rows: Int64[np.ndarray, " m"],
    latents: Float32[np.ndarray, "M D"],
    *,
    min_score: float,
    min_views: int,
    closeness: Closeness | None = None,
) -> tuple[Float32[np.ndarray, "T D"], Bool[np.ndarray, " T"]]:
    """Code of each group by association: in every view the mask that shows it best, averaged over views.

    Source: yanmin-wu/OpenGaussian `train.py`. Departs: the IoU is of visible weights in place of a group
    rendered alone, so that hidden Gaussians do not count.

    Args:
        group: of each Gaussian, -1 for none.
        num_groups: T.
        contributions: of the scene.
        rows: masks that may be chosen.
        latents: code of every mask of the scene.
        min_score: a mask is chosen if its score is above this.
        min_views: groups with masks in fewer views get none.
        closeness: factor of the score for pairs of a mask (place in `rows`) and a group; 1 if missing.

    Returns:
        codes, 0 for groups without one, and which groups have one.
    """
    has = np.flatnonzero(group != NONE)
    num = len(group)
    member = sp.csr_matrix((np.ones(len(has)), (has, group[has])), shape=(num, num_groups))
    weights = contributions.matrix("S")[rows].astype(np.float64)
    shared = (weights @ member).tocoo()
    mask, of = shared.row.astype(np.int64), shared.col.astype(np.int64)
    area = np.asarray(weights.sum(axis=1)).ravel()
    size = np.stack([np.bincount(group[has], seen[has], num_groups) for seen in contributions.mass()])
    view = contributions.view[rows][mask]
    score = shared.data / (area[mask] + size[view, of] - shared.data)
    if closeness is not None:
        score = score * closeness(mask, of)
    order = np.lexsort((mask, -score, of, view))
    key = view[order].astype(np.int64) * num_groups + of[order]
    first = order[np.flatnonzero(np.diff(key, prepend=-1))]
    best = first[score[first] > min_score]
    counts = np.bincount(of[best], minlength=num_groups)
    sums = np.zeros((num_groups, latents.shape[1]))
    np.add.at(sums, of[best], latents[rows[mask[best]]])
    found = counts >= max(min_views, 1)
    means = np.where(found[:, None], sums / np.maximum(counts, 1)[:, None], 0)
    return means.astype(np.float32), found


def features_of_groups(
    group: Int32[np.ndarray, " N"] | Int64[np.ndarray, " N"], latents: Float32[np.ndarray, "T D"]
) -> Float32[np.ndarray, "N D"]:
    """Code of its group for every Gaussian, 0 without a group."""
    nothing = np.zeros((1, latents.shape[1]), np.float32)
    return np.concatenate([latents, nothing])[group]


def thresholds_of(settings: MethodSettings, own: tuple[float, float, float]) -> tuple[float, float, float]:
    """The thresholds that are set, or the method's own, which also say whether they grow or fall.

    Raises:
        SettingsError: they are not in the order of the method's own.
    """
    if settings.thresholds == "auto":
        return own
    grow = own[0] < own[-1]
    whole, part, subpart = settings.thresholds
    if not (whole < part < subpart if grow else whole > part > subpart):
        raise SettingsError(
            f"method.thresholds: {settings.name} cannot nest its levels",
            expected=f"numbers that {'grow' if grow else 'fall'} from whole to subpart, such as {list(own)}",
            found=str(list(settings.thresholds)),
            fix="reorder them",
        )
    return settings.thresholds
