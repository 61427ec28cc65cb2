"""LERF's relevancy on numbers worked by hand."""

import numpy as np
import pytest

from hilsplat.query.relevancy import relevancy


def test_nearest_canonical_phrase_decides():
    # axes are chosen so that the cosines are 0.30 with the text and 0.25, 0.28, 0.20, 0.22
    embedding = np.array([[0.30, 0.25, 0.28, 0.20, 0.22]])
    score = relevancy(embedding, np.eye(5)[:1], np.eye(5)[1:])
    assert score == pytest.approx(np.array([[0.549834]]), abs=1e-6)


def test_as_close_as_the_nearest_phrase_scores_one_half():
    embedding = np.array([[0.3, 0.3, 0.1]])
    assert relevancy(embedding, np.eye(3)[:1], np.eye(3)[1:])[0, 0] == 0.5


def test_rows_are_texts_and_columns_embeddings():
    assert relevancy(np.eye(3), np.eye(3)[:2], np.eye(3)[2:]).shape == (2, 3)
    assert relevancy(np.zeros((0, 3)), np.eye(3)[:2], np.eye(3)[2:]).shape == (2, 0)
