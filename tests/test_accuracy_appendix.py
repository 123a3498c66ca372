"""The accuracy appendix is what its records and its template give."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

ACCURACY = Path(__file__).parent.parent / "experiments" / "accuracy"


@pytest.fixture(scope="module")
def appendix():
    """The module, imported from experiments/accuracy; its names are removed again."""
    before, known = list(sys.path), set(sys.modules)
    sys.path.insert(0, str(ACCURACY))
    import appendix

    yield appendix
    sys.path[:] = before
    for name in {"appendix", "study"} - known:
        del sys.modules[name]


def test_the_page_is_up_to_date(appendix, tmp_path, monkeypatch):
    """Run `python experiments/accuracy_cost.py --write-only` if this fails."""
    committed = appendix.PAGE.read_text()
    monkeypatch.setattr(appendix, "PAGE", tmp_path / "page.md")
    assert appendix.write().read_text() == committed


def test_every_record_is_on_the_page_with_its_picture(appendix):
    page = appendix.PAGE.read_text()
    names = set(json.loads((appendix.RECORDS / "records.json").read_text()))
    assert names == {p.stem for p in appendix.RECORDS.glob("*.csv")}
    for name in names - {"tune", "presets"}:
        assert (
            f"(pictures/{appendix.picture(name).name})" in page and appendix.picture(name).exists()
        )


def test_prose_has_at_most_100_columns(appendix):
    lines = appendix.PAGE.read_text().splitlines()
    assert [x for x in lines if len(x) > appendix.WIDTH and not x.startswith(("|", "!["))] == []


def test_a_study_survives_its_csv_file(appendix, tmp_path):
    """Reading a written CSV file gives the same table."""
    study = appendix.load_study("splitting_boundary")
    appendix.write_csv(study, tmp_path / "one.csv")
    work, points = appendix.read_csv(tmp_path / "one.csv")
    assert work == study.work and points == study.points and any(p.band for p in points)
