"""Tolerances of the comparison with the recorded run."""

from dataclasses import replace

from tests.reference import tiny

NAME = "iou/default/tree/hierarchy/level-given/whole"
OF_LEVEL = "iou/theta-0.6/field/hierarchy/level-given/whole"


def changed(by: float, name: str = NAME, **more: str) -> list[str]:
    """Differences of a run whose number moved."""
    known = tiny.recorded()
    numbers = {**known.numbers, name: known.numbers[name] + by}
    return list(tiny.differences(replace(known, numbers=numbers, **more), known))


def test_an_iou_may_differ_by_a_point_and_more_with_other_gaussians():
    other = {"gaussians_sha256": "other"}
    assert (
        changed(0.009) == changed(-0.009) == changed(-0.1, **other) == changed(0.3, OF_LEVEL, **other) == []
    )
    assert changed(float("nan")) != []
    [sentence] = changed(-0.13, **other)
    assert sentence.startswith(f"{NAME} is ") and sentence.endswith("tolerance 0.12")
    [sentence] = changed(0.37, OF_LEVEL, **other)
    assert sentence.startswith("iou/theta-0.6/field/hierarchy/level-given is "), (
        "levels of sweeps are averaged"
    )


def test_every_recorded_number_has_a_tolerance_and_missing_and_new_ones_are_named():
    known = tiny.recorded()
    for name in known.numbers:
        assert changed(0.0, name) == [] and len(changed(1e4, name)) == 1, name
    assert len(changed(0.011)) == len(changed(-0.011)) == len(changed(0.011, OF_LEVEL)) == 1
    without = replace(known, numbers={name: v for name, v in known.numbers.items() if name != NAME})
    assert list(tiny.differences(without, known)) == [f"{NAME} is missing"]
    assert list(tiny.differences(known, without)) == [f"{NAME} is new"]
