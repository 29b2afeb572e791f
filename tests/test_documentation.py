"""The documentation names existing things (public names, pages, files), and shows docstrings as meant."""

import importlib.util
import json
import re
import subprocess
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import DOCS, ROOT, code_of, run

import jourdain_jax as jj
from jourdain_jax.equations import unconstrained_equations

PAGES = sorted(
    page
    for page in DOCS.rglob("*.md")
    if not {"_build", "pages", "notebooks"} & set(page.relative_to(DOCS).parts)
)
SEARCHED = DOCS / "_build" / "html" / "searchindex.js"
WRITTEN_BY_THE_BUILD = ("gallery/pages/", "tutorials/notebooks/", "notebooks/")


SPACES = ("identification", "studies", "equations", "analysis")
PUBLIC = {*jj.__all__, *(f"{space}.{name}" for space in SPACES for name in getattr(jj, space).__all__)} - {
    *SPACES,
    "models",
    "bicycle",
}


def test_every_public_name_stands_once_in_the_reference():
    pages = "\n".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    named = re.findall(r"auto\w+:: jourdain_jax\.((?:\w+\.)?\w+)$", pages, re.MULTILINE)
    assert sorted(name for name in named if not name.startswith("bicycle.")) == sorted(PUBLIC)


@pytest.mark.skipif(not SEARCHED.exists(), reason="the site is not built; see CONTRIBUTING")
def test_the_search_of_the_built_site_finds_every_public_name():
    written = re.fullmatch(r"Search\.setIndex\((.*)\)\s*", SEARCHED.read_text(encoding="utf-8"), re.DOTALL)
    index = json.loads(written[1])
    found = {
        f"{module}.{entry[-1]}": index["docnames"][entry[0]]
        for module, entries in index["objects"].items()
        for entry in entries
    }
    assert sorted(name for name in PUBLIC if f"jourdain_jax.{name}" not in found) == []
    assert {page.partition("/")[0] for page in found.values()} == {"reference"}


_CODE = re.compile(r"```.*?```", re.DOTALL)


@pytest.mark.parametrize(
    "page",
    [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_links_lead_to_pages_that_exist(page):
    for target, anchor in links(page.read_text(encoding="utf-8")):
        if target.startswith(("http", "mailto")) or any(
            target.removeprefix("../").startswith(part) for part in WRITTEN_BY_THE_BUILD
        ):
            continue
        found = page.parent / target if target else page
        found = found if found.exists() else found.with_suffix(".md")
        assert found.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(found.read_text(encoding="utf-8")), (
            f"{page.name}: {target}#{anchor}"
        )


def test_anchors_of_links_are_seen():
    text = (
        "[a](page.md#some-heading) and [b](#here) and [c](page.md)\n```\n[d](no.md)\n# no heading\n```\n##"
        " Some `heading`: *two*"
    )
    assert links(text) == [("page.md", "some-heading"), ("", "here"), ("page.md", "")]
    assert anchors(text) == {"some-heading-two"}


def links(text):
    """Targets of the links of a page and the anchors on them, those in code left out."""
    return re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)[^)]*\)", _CODE.sub("", text))


def anchors(text):
    """Of the headings of a page, as GitHub and MyST name them: small letters and hyphens."""
    headings = re.findall(r"^#+ +(.+)$", _CODE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_code_fits_the_width_of_a_page(page):
    assert [line for block in code_of(page) for line in block.splitlines() if len(line) > 112] == []


def test_each_formula_of_the_theory_is_followed_by_the_functions_that_compute_it():
    told = (DOCS / "theory.md").read_text(encoding="utf-8").split("$$")
    assert len(told) > 30
    for formula, below in zip(told[1::2], told[2::2], strict=True):
        computed = re.match(r"\n\n\*Computed by\* (.*?)(?:\n\n|$)", below, re.DOTALL)
        assert computed, formula
        functions = ""
        for part in re.split(r"(\[`[\w/]+\.py`\]\([^)]*\))", computed[1]):
            if (link := re.match(r"\[`([\w/]+\.py)`\]\(\.\./src/jourdain_jax/(.*)\)", part)) is None:
                functions += part
                continue
            assert link[1] == link[2]
            source = (ROOT / "src" / "jourdain_jax" / link[1]).read_text(encoding="utf-8")
            for name in re.findall(r"`(\w+)`", functions):
                assert re.search(rf"^(?:def|class) {name}\b", source, re.MULTILINE), (name, link[1])
            functions = ""
        assert "`" not in functions


def test_files_that_the_theory_names_exist():
    text = (DOCS / "theory.md").read_text(encoding="utf-8")
    for name in re.findall(r"`([\w/]+\.py)`", text):
        assert (ROOT / "src" / "jourdain_jax" / name).exists(), name


def test_the_results_of_the_paper_hold_where_they_are_shown():
    page = run(DOCS / "paper_by_example.md")
    text = (DOCS / "paper_by_example.md").read_text(encoding="utf-8")
    assert [f"S{number}" for number in range(1, 13)] == re.findall(r"^## (S\d+)\.", text, re.M)
    assert_allclose(page["force"][:2] @ page["blade"], 0.0, atol=1e-12)
    assert_allclose(page["force"][:2] @ page["across"], page["solved"].multipliers[0], rtol=1e-12)
    assert_allclose(
        page["lagrange"].h, unconstrained_equations(page["pendulum"], *page["here"]).h, atol=1e-12
    )
    assert_allclose(page["by_minimum"], page["solved"].udot, atol=1e-12)
    assert_allclose(page["psi"], page["closed"], atol=1e-10)  # (64), by quasi-velocities
    assert_allclose(page["length"], page["scene"].rod_length, atol=1e-12)


def test_large_scenes_have_as_many_operations_as_their_page_says():
    page = run(DOCS / "howto" / "large_scenes.md", jj=jj, jnp=jnp, eqx=eqx)
    text = (DOCS / "howto" / "large_scenes.md").read_text(encoding="utf-8")
    rows = [
        [cell.strip().replace(",", "") for cell in row.split("|")[1:-1]]
        for row in re.findall(r"^\| \d+ .*$", text, re.M)
    ]
    assert [row[0] for row in rows] == ["4", "16", "32", "64", "200"]
    for row in rows[:2]:
        scenes = jj.models.TrailerChain(trailers=int(row[0])), page["RelativeTrailers"](trailers=int(row[0]))
        found = [
            x for scene in scenes for x in (len(scene.coordinate_names.entries), jj.lower(scene).operations)
        ]
        assert found == [int(row[i]) for i in (1, 2, 4, 5)]


def test_redundant_rows_are_as_their_page_says(capsys):
    page = run(DOCS / "howto" / "redundant_rows.md")
    assert page["two"].succeeded
    assert_allclose(page["three"].q, page["two"].q, atol=1e-12)
    assert not np.any(page["three"].constraint_forces().determined)
    assert np.all(page["two"].constraint_forces().determined)
    told = [line.rpartition("; ")[2] for line in capsys.readouterr().out.splitlines() if "rad/s" in line]
    assert [words == "reached the end of its span" for words in told] == [True, False, True]


def test_the_code_of_the_page_on_inputs_runs():
    page = run(DOCS / "howto" / "inputs.md")
    # the blow of 0.9 N s on 2 kg shows in the speed right after it
    shortly = jj.simulate(page["Cart"](gain=0.0), ts=[0.0, 1.002], inputs={"push": page["blow"]})
    assert_allclose(shortly["x_rate"][-1], 0.45, rtol=5e-3)


def test_the_code_of_the_page_on_events_runs(capsys):
    page = run(DOCS / "howto" / "events.md")
    fall = np.sqrt(2 * 1.0 / 9.81)
    assert_allclose(page["motion"].phases.ts[:2], [fall, fall * (1 + 2 * 0.8)], rtol=1e-7)
    assert page["motion"].phase("stone")[-1] == 1
    assert "stone: rests" in capsys.readouterr().out


def test_a_design_is_made_stable_as_its_page_says(capsys):
    run(DOCS / "howto" / "stable_design.md")
    shown = re.findall(
        r"```text\n(.*?)```", (DOCS / "howto" / "stable_design.md").read_text(encoding="utf-8"), re.S
    )
    assert capsys.readouterr().out == "".join(shown)


def test_the_code_of_the_page_on_what_is_learned_runs():
    page = run(DOCS / "howto" / "learned.md")
    assert page["errors"][-1] < 0.3 * page["errors"][0]


@pytest.mark.parametrize(
    ("way", "files"), [(0, ["sleigh.png"]), (1, ["log.csv", "fit.html"]), (2, ["sweep.zarr", "cluster.zarr"])]
)
def test_the_ways_to_work_of_the_first_page_run_from_an_empty_folder(way, files, tmp_path):
    code = [
        block for block in code_of(DOCS / "index.md") if "print(motion)" not in block and "show(" not in block
    ]
    assert len(code) == 3
    assert len(code[way].splitlines()) <= 40
    subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", code[way]], cwd=tmp_path, check=True)
    assert all((tmp_path / file).exists() for file in files)
    if way == 2:
        found = [jj.load_study(tmp_path / file).to_xarray()["lean"].values for file in files]
        assert found[0].tobytes() == found[1].tobytes()


def test_the_readme_has_at_most_five_hundred_words():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 500


def test_dips_that_may_be_missed_are_named_in_the_same_words():
    said = (
        "smooth dip of an event's value that is shorter than the longest step may be missed, and so may a "
        "condition such as `jnp.linalg.norm(x) < r` that holds only briefly"
    )
    pages = [(ROOT / "docs" / page).read_text(encoding="utf-8") for page in ("limits.md", "howto/events.md")]
    for text in (*pages, jj.Scene.events.__doc__, jj.Event.__doc__):
        assert said in " ".join(text.split())


def test_the_site_has_at_most_28_000_words():
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in PAGES) <= 28_000


def _docstrings():
    path = DOCS / "sphinx_parts" / "docstrings.py"
    spec = importlib.util.spec_from_file_location("docstrings", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_docstrings_are_read_as_they_are_meant():
    lines = [
        "Shape (times, *lanes), |x| of `a *b`.",
        "",
        "    x = 1",
        "",
        "    y = 2",
        "",
        "**Items**",
        "- `t`: **s**",
        "  and on",
        "- u",
    ]
    expected = ["Shape (times, \\*lanes), \\|x\\| of `a *b`.", "", "::", "", *lines[2:7], "", *lines[7:]]
    assert _docstrings().as_rest(lines) == expected
