"""The README's code runs as it stands."""

from pages import ROOT, code_of, run

README = ROOT / "README.md"


def test_the_quickstart_has_at_most_fifteen_lines_of_code():
    lines = [line for line in code_of(README)[0].splitlines() if line.strip()]
    assert len(lines) <= 15


def test_all_code_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(README)
    printed = capsys.readouterr().out
    assert "reached the end of its span" in printed
    assert "Verification of Sleigh: passed" in printed
    assert (tmp_path / "disc.html").stat().st_size > 5000
