"""The documentation matches the code: it describes every public name, and its examples run."""

import ast
import contextlib
import io
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import click
import pytest

import catstream
from catstream.base.settings import PRESETS, describe
from catstream.cli import COMMANDS, load_command
from catstream.jobs.job import Results
from catstream.sinks.destinations import SINKS
from catstream.sinks.exports import EXPORTS
from catstream.sinks.track_log import places_of

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("benchmarks/*.md"), *DOCS.glob("**/*.md")])

sys.path.append(str(DOCS))

import hooks  # noqa: E402


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def everything() -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in PAGES)


def prose(path: Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def blocks(path: Path, language: str) -> Iterator[str]:
    """Contents of the fenced blocks of a language."""
    yield from re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands(path: Path) -> Iterator[list[str]]:
    """Words of each command after a prompt on a page."""
    for block in blocks(path, "console"):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("$ "):
                yield shlex.split(line.removeprefix("$ "), comments=True)


def anchors(path: Path) -> set[str]:
    """Anchors of a page, which a link may name after #."""
    headings = re.findall(r"^#+ (.*)", prose(path), re.MULTILINE)
    headings += COMMANDS if path.name == "command-line.md" else ()  # hooks.py adds their sections
    return {re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@cache
def every_command() -> dict[str, click.Command]:
    """All commands by their words, also those of the groups: "track", "fleet", "fleet up"."""
    found = {}
    for name in COMMANDS:
        found[name] = group = load_command(name)
        if isinstance(group, click.Group):
            with click.Context(group) as context:
                each = {word: group.get_command(context, word) for word in group.list_commands(context)}
            found |= {f"{name} {word}": command for word, command in each.items() if command is not None}
    return found


def built(name: str) -> str:
    """What MkDocs adds to a page."""
    return hooks.on_page_markdown("", SimpleNamespace(file=SimpleNamespace(src_uri=name)))


def test_every_setting_and_preset_has_its_row_on_the_page_of_settings():
    rows = built("settings.md")
    for name, setting in describe().items():
        assert f"| `{name}` |" in rows
        assert setting.about, f"{name}: write what it means, in the docstring of its group"
        assert setting.about.count(". ") >= 1, f"{name}: write when to change it"
    assert all(f"| `{preset}` |" in rows for preset in PRESETS)
    assert not built("api.md").strip()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_is_shown(name):
    assert f"`{name}`" in page("README.md") or f"catstream {name}" in page("README.md"), f"README.md: add {name}"
    assert re.search(rf"catstream {name}\b", everything()), f"no page of docs/ shows `catstream {name}`"


def test_the_first_page_has_the_table_of_pages_of_the_readme():
    linked = re.findall(r"\]\((\S+?)\)", built("index.md"))
    assert len(linked) > 30
    assert all((DOCS / link).is_file() for link in linked)


def test_every_command_and_option_has_help_and_a_name_of_its_own():
    """The page of the command line is made from it when the documentation is built."""
    for words, command in every_command().items():
        assert command.help, f"{words}: write its docstring"
        assert len({option.name for option in command.params}) == len(command.params), f"{words}: two of one name"
        for option in command.params:
            assert not isinstance(option, click.Option) or option.help, f"{words} --{option.name}: add help"


def test_the_page_of_the_architecture_names_each_entry_of_the_library():
    rows = page("docs/architecture.md").partition("## Packages\n")[2].partition("\n**Imports")[0]
    named = {name for row in re.findall(r"^\| (`.*?) \|", rows, re.M) for name in re.findall(r"`(.*?)`", row)}
    there = {path.name for path in (ROOT / "catstream").iterdir()}
    assert named == {name for name in there if name[0] != "_" and name != "py.typed"}, (
        "docs/architecture.md, the packages: name each file and package of catstream/"
    )


def test_every_destination_and_format_of_tracks_is_explained():
    shown = page("docs/how-to/sinks.md")
    for name in places_of("NAME", Results(Path(), video=True)):
        assert f"`{name}`" in shown
        assert f"`{name}`" in page("docs/tutorial.md")
    for key in [*(f"FILE{key}" if key[0] == "." else key for key in SINKS), *EXPORTS]:
        assert f"`{key}`" in shown, f"docs/how-to/sinks.md does not say what {key} is"


def errors_on(check: Callable[[Path], Iterator[str]]) -> str:
    """The errors of all pages, one line each."""
    return "\n".join(f"{path.relative_to(ROOT)} {wrong}" for path in PAGES for wrong in check(path))


def broken_links(path: Path) -> Iterator[str]:
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        if "://" not in link and not target.exists():
            yield f"links to {link}, which does not exist"
        elif "://" not in link and anchor and anchor not in anchors(target):
            yield f"links to {link}, but it has no such heading"


def test_the_targets_of_links_exist():
    assert not errors_on(broken_links)


@pytest.mark.parametrize("picture", sorted(DOCS.glob("images/*.svg")), ids=lambda path: path.name)
def test_the_svg_files_are_well_formed(picture):
    ElementTree.parse(picture)


def wrong_commands(path: Path) -> Iterator[str]:
    targets = set(re.findall(r"^([a-z-]+):", page("Makefile"), re.MULTILINE))
    for program, *words in commands(path):
        if program == "make" and words[0] not in targets:
            yield f"shows `make {words[0]}`, but there is no such target"
        if program == "catstream":
            yield from wrong_words(words)


def wrong_words(words: list[str]) -> Iterator[str]:
    """Of a command of catstream."""
    known = every_command()
    name = next((name for name in (" ".join(words[:2]), words[0]) if name in known), "")
    if not name or isinstance(known[name], click.Group):
        yield f"shows `catstream {' '.join(words[:2])}`, but there is no such command"
        return
    with click.Context(known[name]) as context:
        flags = {flag for option in known[name].get_params(context) for flag in option.opts}
    if wrong := {word for word in words if word.startswith("--")} - flags:
        yield f"shows `catstream {name}` with {wrong}, which are no options of it"


def test_the_commands_of_the_pages_exist():
    """Commands, options and targets of make."""
    assert not errors_on(wrong_commands)


def unknown_names(path: Path) -> Iterator[str]:
    for node in (node for block in blocks(path, "python") for node in ast.walk(ast.parse(block))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("catstream"):
            module = import_module(node.module or "")
            yield from (f"imports {alias.name}" for alias in node.names if not hasattr(module, alias.name))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "catstream":
            yield from () if node.attr in catstream.__all__ else (f"uses catstream.{node.attr}",)


def test_the_python_examples_use_existing_names():
    assert not errors_on(unknown_names)


@pytest.mark.timeout(900)  # mypy reads the types of all libraries
def test_a_type_checker_accepts_the_python_examples(tmp_path):
    for page in (ROOT / "README.md", DOCS / "tutorial.md"):
        for number, block in enumerate(blocks(page, "python")):
            if "import" in block:  # otherwise it continues the one before
                file = tmp_path / f"{page.stem}_{number}.py"
            with file.open("a") as program:
                program.write(block)
    programs = [
        *sorted(tmp_path.glob("*.py")),
        *(ROOT / "examples").glob("*.py"),
        *(ROOT / "examples").glob("*/main.py"),
    ]
    command = [sys.executable, "-m", "mypy", "--no-error-summary", *map(str, programs)]  # with the cache of `make lint`
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("", "")


def test_the_tutorials_tracker_follows(demo_video, tmp_path, monkeypatch):
    (tmp_path / "demo").symlink_to(demo_video(24)[0].parent)
    monkeypatch.chdir(tmp_path)
    section = [block for block in blocks(DOCS / "tutorial.md", "python") if "tracker" in block]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile("\n".join(section), "docs/tutorial.md", "exec"), {})
    assert printed.getvalue().startswith("present")


def test_the_examples_of_coreset_trees_summarise_a_stream():
    program = "\n".join(blocks(DOCS / "coreset-trees.md", "python")).replace("1_000_000", "20_000")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(program, "docs/coreset-trees.md", "exec"), {})
    rows, *figures = printed.getvalue().splitlines()
    assert rows.startswith("20000 rows in ")
    variance, error, accuracy = (float(line.rpartition(" ")[2].rstrip("%")) for line in figures)
    assert variance == pytest.approx(74, abs=1)
    assert error < 0.1
    assert accuracy > 90


def test_every_test_that_a_page_names_exists():
    tests = "\n".join(path.read_text(encoding="utf-8") for path in ROOT.glob("tests/**/test_*.py"))
    for name in set(re.findall(r"`(test_\w+)`", everything())):
        assert f"def {name}(" in tests, f"a page names {name}, but there is no such test"


def test_every_extra_that_a_page_names_can_be_installed():
    extras = tomllib.loads(page("pyproject.toml"))["project"]["optional-dependencies"]
    assert set(re.findall(r"catstream\[(\w+)\]", everything())) <= set(extras), "pyproject.toml: add the extra"


def test_the_version_is_the_same_everywhere_and_the_reference_has_all_public_names():
    assert tomllib.loads(page("pyproject.toml"))["project"]["version"] == catstream.__version__
    assert set(dir(catstream)) >= {*catstream.__all__, "__doc__"}, "before their first use"
    shown = set(re.findall(r"^::: catstream\.(\w+)", page("docs/api.md"), re.MULTILINE))
    assert shown - {"errors", "sketch"} == set(catstream.__all__) - {"CatstreamError", "__version__"}
