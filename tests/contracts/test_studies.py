"""Each study is a short script with a page, figures that are kept with seeds and versions, and a picture."""

import json

import pytest

from studies import study

PAGES = sorted(page for page in study.PAGES.glob("*.md") if page.stem != "README")
SCRIPTS = study.PAGES.parents[1] / "tests" / "studies"
TEXTBOOK = ("square", "doppelganger", "global_adjustment", "keyframe_policies", "monocular_odometry")
MOST_LINES = 150  # of those that teach


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_study_is_whole(page: study.Path) -> None:
    name = page.stem
    script = (SCRIPTS / f"{name}.py").read_text()
    assert name not in TEXTBOOK or len(script.splitlines()) <= MOST_LINES
    assert f"({name}.md)" in (study.PAGES / "README.md").read_text()
    assert (study.PAGES / f"{name}.png").stat().st_size > 1000
    kept = json.loads((study.PAGES / f"{name}.json").read_text())
    text = page.read_text()
    assert f"]({name}.png)" in text
    assert f"make study NAME={name}" in text
    assert all(f"{package} {version}" in text for package, version in kept["about"].items()), (
        "not the page of these figures"
    )
    assert all(str(seed) in text for seed in kept["seeds"])
    assert all(row["cpu_s"] >= 0 for row in kept["rows"])


def test_every_script_has_its_page() -> None:
    names = {script.stem for script in SCRIPTS.glob("*.py")} - {"__init__", "study"}
    assert names == {page.stem for page in PAGES}


def test_what_was_stopped_goes_on(tmp_path: study.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "PAGES", tmp_path)
    made: list[str] = []

    def case(name: str) -> study.Row:
        if name == "c" and made.count("c") == 0:
            made.append(name)
            raise KeyboardInterrupt
        made.append(name)
        return {"value": len(made)}

    cases = {name: lambda name=name: case(name) for name in "abc"}
    with pytest.raises(KeyboardInterrupt):
        study.results("counted", cases, [1])
    rows = study.results("counted", cases, [1])
    assert made == ["a", "b", "c", "c"]
    assert [row["value"] for row in rows] == [1, 2, 4]


def test_the_readme_shows_the_table_of_public_sequences() -> None:
    page, readme = ((study.PAGES / "public_sequences.md"), study.PAGES.parents[1] / "README.md")
    table = readme.read_text().partition("<!-- begin of results -->")[2].partition("<!-- end of results -->")[0].strip()
    assert table.startswith("| recording |")
    assert table in page.read_text()
