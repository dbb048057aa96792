from pipeline.curate import Json
from workflows.task import rotation_notes


def _document(*answers: dict[str, Json]) -> dict[str, Json]:
    return {"image_id": "a", "techniques": list(answers)}


def test_rotation_line_says_when_the_bound_was_reached() -> None:
    inside: dict[str, Json] = {
        "technique": "T", "rotation_deg": 1.25, "sigma_rotation_deg": 0.01, "at_edge_rotation": False,
    }  # fmt: skip
    assert rotation_notes(_document(inside)) == ("a T: rotation +1.2500 deg, sigma 0.0100 deg",)
    assert rotation_notes(_document(inside | {"at_edge_rotation": True}))[0].endswith("deg AT_EDGE")


def test_no_rotation_no_line() -> None:
    unseen: dict[str, Json] = {"technique": "T", "rotation_deg": None, "sigma_rotation_deg": None}
    assert rotation_notes(_document(unseen, {"technique": "F", "detail": "failed"})) == ()
    assert rotation_notes({"image_id": "x", "techniques": []}) == ()
