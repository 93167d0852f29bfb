"""The documentation matches the code: it describes every public name, and its examples run."""

import ast
import contextlib
import io
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import click
import pytest

import catstream
from catstream.base.settings import PRESETS, describe
from catstream.cli import COMMANDS, load_command
from catstream.output.destinations import SINKS
from catstream.output.exports import EXPORTS
from catstream.output.track_log import destinations_of
from catstream.processes.job import Results

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("benchmarks/*.md"), *DOCS.glob("**/*.md")])

sys.path.append(str(DOCS))

import hooks  # noqa: E402


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(path: Path, language: str) -> list[str]:
    """Contents of the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def prose(path: Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


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


def test_every_setting_and_preset_has_a_row_on_its_page():
    rows = hooks.settings()
    for name, setting in describe().items():
        assert f"| `{name}` |" in rows
        assert setting.about.count(". ") >= 1, f"{name}: write its meaning and when to change it"
    assert all(f"| `{preset}` |" in rows for preset in PRESETS)


def test_every_command_and_option_has_help_and_is_shown():
    """The page of the command line is made from the help when the documentation is built."""
    shown = "\n".join(path.read_text(encoding="utf-8") for path in PAGES)
    for words, command in every_command().items():
        assert command.help, f"{words}: write its docstring"
        for option in command.params:
            assert not isinstance(option, click.Option) or option.help, f"{words} --{option.name}: add help"
    for name in COMMANDS:
        assert re.search(rf"`{name}`|catstream {name}\b", page("README.md")), f"README.md: add {name}"
        assert re.search(rf"catstream {name}\b", shown), f"no page of docs/ shows `catstream {name}`"
        assert "EXAMPLES" in (every_command()[name].help or ""), f"{name}: add an example to its docstring"


def test_every_destination_and_format_of_tracks_is_explained():
    shown = page("docs/how-to/sinks.md")
    for name in destinations_of("NAME", Results(Path(), video=True)):
        assert f"`{name}`" in shown
        assert f"`{name}`" in page("docs/tutorial.md")
    names = {".": "FILE", "/": "DIR"}
    for key in [*(names.get(key[0], "") + key for key in SINKS), *EXPORTS]:
        assert f"`{key}`" in shown, f"docs/how-to/sinks.md does not say what {key} is"


def wrong_links(path: Path) -> Iterator[str]:
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        if "://" in link:
            continue
        if not target.exists():
            yield f"links to {link}, which does not exist"
        elif anchor:
            headings = [*re.findall(r"^#+ (.*)", prose(target), re.M), *COMMANDS]  # hooks.py adds those of the commands
            if anchor not in {re.sub(r"[^\w -]", "", each.lower()).strip().replace(" ", "-") for each in headings}:
                yield f"links to {link}, but it has no such heading"


def wrong_commands(path: Path) -> Iterator[str]:
    """Commands, options and targets of make that do not exist."""
    targets = re.findall(r"^([a-z-]+):", page("Makefile"), re.MULTILINE)
    lines = (line for block in blocks(path, "console") for line in block.replace("\\\n", " ").splitlines())
    for program, *words in (shlex.split(line[2:], comments=True) for line in lines if line.startswith("$ ")):
        if program == "make" and words[0] not in targets:
            yield f"shows `make {words[0]}`, but there is no such target"
        if program == "catstream":
            name = next((name for name in (" ".join(words[:2]), words[0]) if name in every_command()), "")
            command = every_command().get(name)
            if command is None or (isinstance(command, click.Group) and not command.invoke_without_command):
                yield f"shows `catstream {' '.join(words[:2])}`, but there is no such command"
                continue
            flags = {flag for option in command.get_params(click.Context(command)) for flag in option.opts}
            if wrong := {word for word in words if word.startswith("--")} - flags:
                yield f"shows `catstream {name}` with {wrong}, which are no options of it"


def wrong_names(path: Path) -> Iterator[str]:
    """Tests that do not exist, and names that Python examples import or use although they do not exist."""
    for name in re.findall(r"`(test_\w+)`", prose(path)):
        if not any(f"def {name}(" in file.read_text(encoding="utf-8") for file in ROOT.glob("tests/**/test_*.py")):
            yield f"names {name}, but there is no such test"
    for node in (node for block in blocks(path, "python") for node in ast.walk(ast.parse(block))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("catstream"):
            module = import_module(node.module or "")
            yield from (f"imports {alias.name}" for alias in node.names if not hasattr(module, alias.name))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "catstream":
            yield from () if node.attr in catstream.__all__ else (f"uses catstream.{node.attr}",)


def wrong_files(path: Path) -> Iterator[str]:
    """Files that do not exist; a path begins at the root or in `catstream`. Scripts that were removed have a table."""
    for name in re.findall(r"`([a-z_]+/[a-z_/]+\.(?:py|toml|service))`", prose(path).partition("## Measured once")[0]):
        if not any((root / name).is_file() for root in (ROOT, ROOT / "catstream", ROOT / "benchmarks")):
            yield f"names {name}, but there is no such file"


RULES = {"links": wrong_links, "commands": wrong_commands, "names": wrong_names, "files": wrong_files}


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_links_commands_and_names_on_pages_exist(rule):
    wrong = [f"{path.relative_to(ROOT)} {each}" for path in PAGES for each in rule(path)]
    assert not wrong, "\n".join(wrong)


def printed_by(name: str, program: str) -> str:
    """The output of a program of a page."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(program, name, "exec"), {})
    return printed.getvalue()


def test_tracker_of_the_tutorial_tracks(demo_video, tmp_path, monkeypatch):
    (tmp_path / "demo").symlink_to(demo_video(24)[0].parent)
    monkeypatch.chdir(tmp_path)
    program = "\n".join(block for block in blocks(DOCS / "tutorial.md", "python") if "tracker" in block)
    assert printed_by("tutorial.md", program).startswith("present")


def test_examples_of_coreset_trees_run():
    program = "\n".join(blocks(DOCS / "coreset-trees.md", "python")).replace("1_000_000", "20_000")
    assert printed_by("coreset-trees.md", program).startswith("20000 rows in ")


def test_reference_has_the_version_and_all_public_names():
    assert tomllib.loads(page("pyproject.toml"))["project"]["version"] == catstream.__version__
    assert set(dir(catstream)) >= {*catstream.__all__, "__doc__"}, "before their first use"
    shown = set(re.findall(r"^::: catstream\.(\w+)", page("docs/api.md"), re.MULTILINE))
    assert shown - {"errors", "sketch"} == set(catstream.__all__) - {"CatstreamError", "__version__"}
