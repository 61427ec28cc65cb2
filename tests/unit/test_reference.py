"""Tolerances of the comparison with the recorded run."""

from dataclasses import replace

from tests.reference import tiny

NAME = "iou/default/tree/hierarchy/level-given/whole"


def changed(by: float, name: str = NAME, **more: str) -> list[str]:
    """Differences of a run whose number moved."""
    known = tiny.recorded()
    return list(
        tiny.differences(
            replace(known, numbers={**known.numbers, name: known.numbers[name] + by}, **more), known
        )
    )


def test_an_iou_may_differ_by_a_point_and_more_with_other_gaussians():
    assert changed(0.0) == changed(0.009) == changed(-0.009) == []
    assert len(changed(0.011)) == len(changed(-0.011)) == 1
    assert changed(float("nan")) != []
    assert changed(-0.1, gaussians_sha256="other") == []
    [sentence] = changed(-0.13, gaussians_sha256="other")
    assert sentence.startswith(f"{NAME} is ") and sentence.endswith("tolerance 0.12")


def test_levels_of_a_sweep_are_averaged_with_other_gaussians():
    of_level = "iou/theta-0.6/field/hierarchy/level-given/whole"
    assert changed(0.3, of_level, gaussians_sha256="other") == []
    [sentence] = changed(0.37, of_level, gaussians_sha256="other")
    assert sentence.startswith("iou/theta-0.6/field/hierarchy/level-given is ")
    assert len(changed(0.011, of_level)) == 1


def test_every_recorded_number_has_a_tolerance():
    for name in tiny.recorded().numbers:
        assert changed(0.0, name) == [] and len(changed(1e4, name)) == 1, name


def test_missing_and_new_numbers_are_named():
    known = tiny.recorded()
    without = replace(known, numbers={name: v for name, v in known.numbers.items() if name != NAME})
    assert list(tiny.differences(without, known)) == [f"{NAME} is missing"]
    assert list(tiny.differences(known, without)) == [f"{NAME} is new"]
