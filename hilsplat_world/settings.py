"""Settings of the synthetic world and of its diagnostic segmenter."""

from hilsplat.settings import Section, Share, knob


class WorldSettings(Section):
    """Rendering of a synthetic scene. The content depends on its kind and seed, given in the scene sheet."""

    views: int = knob(40, "number of views", unit="views", ge=3, le=1000)
    image_px: int = knob(256, "height and width of each view", unit="px", ge=32, le=4096)
    arc_deg: float = knob(360.0, "azimuth covered by the cameras; 360: a circle", unit="degree", gt=0, le=360)
    objects: int = knob(6, "objects to place; the log reports how many fit", unit="objects", ge=1, le=30)
    samples: int = knob(3, "samples per pixel along each side", ge=1, le=8)
    min_area_px: int = knob(60, "minimum visible area of scored wholes and parts", unit="px", ge=1)


class PerturbSettings(Section):
    """Faults added to ground-truth masks, used only with masks.segmenter: truth-perturbed.

    The defaults approximate a good SAM on a clean image of about 256 px: slightly more consistent across
    views than the embedded model (`hilsplat world inconsistency`). With all faults at 0, masks equal the
    ground truth. Systematic faults are drawn once per scene, which has few wholes, so average over seeds.
    """

    seed: int = knob(0, "seed of the faults; independent of the run's seed", ge=0)
    boundary_px: float = knob(
        0.6, "standard deviation of the boundary's displacement along its normal", unit="px", ge=0, le=64
    )
    boundary_smooth_px: float = knob(
        6.0, "length along the boundary over which the displacement changes", unit="px", ge=1, le=256
    )
    merge: Share = knob(0.02, "probability per node and view of merging with a touching sibling")
    split: Share = knob(0.02, "probability per mask of being cut in two")
    missing: tuple[Share, Share, Share] = knob(
        (0.01, 0.04, 0.1), "probability that a mask is missing: whole, part, subpart"
    )
    wrong_level: Share = knob(0.02, "probability that a mask is one level off")
    systematic_merge: Share = knob(0.02, "probability per node of the same wrong merge in most views")
    systematic_missing: Share = knob(0.02, "probability that a node has no mask in most views")
    systematic_share: Share = knob(0.9, "probability that a systematic fault occurs in a view")
    score_noise: Share = knob(0.05, "standard deviation of predicted IoU and stability about the truth")
