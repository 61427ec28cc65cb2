"""Agreement of networks of lower precision, which is measured once for the same inputs and code."""

from hilsplat.models import int8
from hilsplat.models.int8 import use_reduced


def test_an_agreement_is_measured_again_by_other_code_or_for_other_inputs(tmp_path, monkeypatch):
    found = []

    def measure() -> dict[str, float]:
        found.append(len(found))
        return {"cosine": 0.995 if len(found) == 1 else 0.5}

    def is_used(model: str) -> bool:
        return use_reduced("int8", "auto", "CLIP", tmp_path, {"model": model}, measure)

    assert [is_used("one"), is_used("one"), is_used("two")] == [True, True, False] and len(found) == 2
    monkeypatch.setattr(int8, "code_digest", lambda *roots: "edited")
    assert not is_used("one") and len(found) == 3
