"""What the reader sees is executed."""

from pathlib import Path

import pages

ROOT = Path(__file__).parent.parent


def test_the_readme_examples_run_as_printed(tmp_path):
    """In an empty folder: what they need they make."""
    said = pages.execute(ROOT / "README.md", tmp_path)
    assert (tmp_path / "walk.png").stat().st_size > 20_000
    assert "p50" in said
    assert "Pose(" in said
