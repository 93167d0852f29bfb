"""Hook of MkDocs: adds the commands, the settings and the pages outside `docs/` to the documentation."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path
from typing import Any

import click
from mkdocs.structure.files import File, Files

from catstream.base.settings import PRESETS, RESUMABLE, describe
from catstream.cli import COMMANDS, load_command

ROOT = Path(__file__).parents[1]
#: Pages outside `docs/`, and their places in the built site.
OUTSIDE = {"README.md": "index.md"} | {
    name: name
    for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "benchmarks/README.md", "benchmarks/parameters.md")
}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages outside `docs/` to the site; README is its first page."""
    for path, page in OUTSIDE.items():
        text = (ROOT / path).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Append the help of all commands, or the settings, to their page, and adapt links to pages outside `docs/`."""
    place = page.file.src_uri
    if place in OUTSIDE.values():
        return re.sub(r"\]\(((?:\.\./)*)docs/", r"](\1", markdown)
    outside = "../" * (place.count("/") + 1)  # from the page to the root of the repository
    markdown = markdown.replace(f"]({outside}", f"]({outside.removeprefix('../')}").replace("](README.md", "](index.md")
    pages = {"command-line.md": commands, "settings.md": settings}
    added = pages.get(place)
    return f"{markdown}\n{added()}" if added else markdown


def settings() -> str:
    """Return the tables of settings and of presets in Markdown."""
    lines = ["", "| setting | takes | default | meaning |", "| --- | --- | --- | --- |"]
    for name, setting in describe().items():
        default = "empty" if setting.default == "" else json.dumps(setting.default).strip('"')
        takes = setting.takes.replace("|", "&#124;")
        about = f"{setting.about} May change at a resume." if name in RESUMABLE else setting.about
        lines.append(f"| `{name}` | {takes} | {default} | {about} |")
    lines += ["", "### Presets", "", "| preset | sets |", "| --- | --- |"]
    for preset, values in PRESETS.items():
        pairs = ", ".join(f"`{name} = {json.dumps(value)}`" for name, value in values.items())
        lines.append(f"| `{preset}` | {pairs} |")
    return "\n".join(lines) + "\n"


def commands() -> str:
    """Return the help of every command in Markdown."""
    return "\n".join(line for name in COMMANDS for line in described(load_command(name), f"catstream {name}", level=2))


def described(command: click.Command, path: str, level: int) -> Iterator[str]:
    """Yield the lines of a command, and those of its own commands if it is a group."""
    with click.Context(command, info_name=path) as context:
        words = " ".join(command.collect_usage_pieces(context))
        yield f"{'#' * level} {path.removeprefix('catstream ')}\n\n```\n{path} {words}\n```\n"
        yield from map(paragraph, cleandoc(command.help or "").split("\n\n"))
        rows = [option.get_help_record(context) for option in command.params if isinstance(option, click.Option)]
        if rows:
            yield "| option | meaning |\n| --- | --- |"
            yield from (f"| `{names}` | {meaning.replace('|', '&#124;')} |" for names, meaning in filter(None, rows))
            yield ""
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                if (each := command.get_command(context, name)) is not None:
                    yield from described(each, f"{path} {name}", level + 1)


def paragraph(text: str) -> str:
    """Return a paragraph of a docstring in Markdown. One that click must not wrap is shown as it is."""
    _, unwrapped, lines = text.rpartition("\b\n")
    return f"```\n{lines}\n```\n" if unwrapped else f"{text}\n"
