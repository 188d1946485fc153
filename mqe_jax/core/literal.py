"""Texts of others (paths, names, settings, errors), shown as they are.

They go to a terminal, HTML, Markdown, or a figure.
"""

import html
import re
import sys

_MARKDOWN = re.compile(r"[\\`*_\[\]|~]")


def line(text: object) -> str:
    """Returns a text as one line for a terminal: no control character, such as escape, remains."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(str(text).split()))


def echo(text: object) -> None:
    """Prints a text as one line to standard error."""
    print(line(text), file=sys.stderr, flush=True)


def to_html(text: object) -> str:
    """Returns a text as HTML, for elements and attributes."""
    return html.escape(line(text))


def to_markdown(text: object) -> str:
    """Returns a text as Markdown, for paragraphs and cells of tables."""
    return _MARKDOWN.sub(r"\\\g<0>", to_html(text))


def to_label(text: object) -> str:
    """Returns a text as a label of matplotlib, which reads formulas between dollars."""
    return line(text).replace("$", r"\$")
