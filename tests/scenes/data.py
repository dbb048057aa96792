"""Where independent data lie; tests that need them are skipped where they are absent."""

import json
import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("PILOTAGE_DATA", Path(__file__).parents[3] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="independent data are not beside the checkout")


def truth_of(folder: str) -> dict[str, dict[str, float]]:
    """Planted or published answers by image id."""
    frames = json.loads((DATA / folder / "truth.json").read_text())["frames"]
    return {key.removesuffix(".fits"): value for key, value in frames.items()}
