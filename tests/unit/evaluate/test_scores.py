"""The table of scores that a run prints."""

from hilsplat.evaluate.scores import Score, score_summary, write_scores


def test_the_summary_averages_over_queries_and_views(tmp_path):
    def score(method: str, metric: str, value: float, query: str, protocol: str) -> Score:
        return Score(
            "annotated", "desk", "default", "sam", method, "a.png", query, "", metric, protocol, value, 1
        )

    tree, field = "lerf/tree-nodes@5", "lerf/langsplat@2"
    write_scores(
        tmp_path / "scores.csv",
        [
            score("tree", "iou", 0.5, "mug", tree),
            score("tree", "iou", 1.0, "pen", tree),
            score("tree", "localization_mask", 1.0, "mug", tree),
            score("field", "iou", 0.25, "mug", field),
        ],
    )
    heading, columns, *lines = score_summary("photos/desk", {"hilsplat": tmp_path / "scores.csv"})
    assert "photos/desk" in heading and columns.split() == ["mIoU", "localized", "queries", "protocol"]
    assert [line.split() for line in lines] == [
        ["hilsplat,", "field", "25.0%", "-", "1", field],
        ["hilsplat,", "tree", "75.0%", "100.0%", "2", tree],
    ]
    assert score_summary("photos/desk", {}) == []
