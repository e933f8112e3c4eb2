"""From the template to Markdown, and from that to one HTML file and a PDF, without a network."""

import io
import os
import re
from base64 import b64decode, b64encode
from collections import Counter
from pathlib import Path
from typing import Any

import matplotlib
import pypandoc
import typst
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from helpers.report.tables import ROMAN, to_markdown
from helpers.runs.sources import PROJECT

PALETTE = 64  # colours of a picture inside a drawing, each with its own opacity
TEMPLATE = PROJECT / "reports/template"
WORDS = {"fig": "Figure", "tab": "Table", "eq": "Eq."}
OPTIONS = ["--standalone", "--citeproc", f"--bibliography={TEMPLATE / 'references.bib'}", "--metadata=link-citations:true"]
OPTIONS += ["--columns=10000"]  # otherwise a long line in the source of a table fixes the widths of its columns


def environment() -> Environment:
    """What the templates are written for."""
    found = Environment(
        loader=FileSystemLoader(TEMPLATE),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        comment_start_string="{##",  # pandoc writes {#name}
        comment_end_string="##}",
    )
    found.filters["percent"] = lambda share: f"{100 * share:.1f} %"
    found.filters["numeral"] = lambda case: ROMAN[case - 1]
    found.filters["table"] = to_markdown
    return found


def render(template: str, folder: Path, **values: Any) -> str:
    """A template as Markdown, its figures, tables and equations numbered; links to the project's files lead from `folder`."""

    def link(words: str, place: str) -> str:
        return f"[{words}]({Path(os.path.relpath(PROJECT / place, folder)).as_posix()})"

    return numbered(environment().get_template(template).render(link=link, **values))


def numbered(text: str) -> str:
    """The Markdown with a number for every `#fig:name#` (tab, eq), in their order, and a link for every `@fig:name`.

    What stands in a fold, `#A:fig:name#`, is counted apart. A number leads back to the first link to it; a link to what does not
    exist raises KeyError.
    """
    counts: Counter[str] = Counter()
    numbers: dict[str, str] = {}
    for fold, kind, name in re.findall(r"#(A:)?(fig|tab|eq):(\w+)#", text):
        counts[fold + kind] += 1
        numbers[f"{kind}-{name}"] = f"{WORDS[kind]} {fold[:1]}{counts[fold + kind]}"
    linked: set[str] = set()

    def refer(found: re.Match[str]) -> str:
        place = f"{found[1]}-{found[2]}"
        back = "" if place in linked else f"{{#to-{place}}}"
        linked.add(place)
        return f"[{numbers[place]}](#{place}){back}".replace(" ", "\N{NO-BREAK SPACE}")

    def define(found: re.Match[str]) -> str:
        place = f"{found[2]}-{found[3]}"
        if found[2] == "eq":
            return f"({numbers[place].rpartition(' ')[2]})"
        return f"[{numbers[place]}.](#to-{place})" if place in linked else f"{numbers[place]}."

    text = re.sub(r"@(fig|tab|eq):(\w+)", refer, text)
    return re.sub(r"#(A:)?(fig|tab|eq):(\w+)#", define, text)


def to_html(text: str, folder: Path) -> None:
    """report.html, one file that needs no network: figures inside, maths as MathML."""
    options = ["--mathml", "--embed-resources", "--toc", "--toc-depth=2", "--section-divs", f"--resource-path={folder}"]
    options += [f"--css={TEMPLATE / 'report.css'}"]
    pypandoc.convert_text(text, "html5", format="markdown", outputfile=str(folder / "report.html"), extra_args=[*OPTIONS, *options])


def to_pdf(text: str, folder: Path) -> None:
    """report.pdf, by way of Typst with the fonts of matplotlib, in which the figures are written.

    Without the tags that read a PDF aloud, which are more than half of it: report.html can be read aloud.
    """
    text = re.sub(r"\[([^][]*)\]\(#to-[^)]*\)", r"\1", text)  # a link has no place there that could be led back to
    source = pypandoc.convert_text(text, "typst", format="markdown", extra_args=[*OPTIONS, f"--template={TEMPLATE / 'report.typ'}"])
    (folder / "report.typ").write_text(source, encoding="utf-8")
    fonts = Path(matplotlib.get_data_path()) / "fonts/ttf"
    typst.compile(folder / "report.typ", output=folder / "report.pdf", font_paths=[fonts], ignore_system_fonts=True, pdf_tags=False)
    (folder / "report.typ").unlink()


def shortened(drawing: str) -> str:
    """An SVG drawing in less than half the bytes, without what no screen shows.

    Coordinates have two decimals, the font is named once, nothing is indented, named without being referred to or turned by nought,
    and pictures of lines have a palette.
    """
    drawing = re.sub(r' (?:[dxy]="|transform="[rt])[^"]*"', lambda found: re.sub(r"(\.\d\d)\d+", r"\1", found[0]), drawing)
    drawing = re.sub(
        r' transform="rotate\(-?0 [^"]*"|(?<=\n) +|<metadata>.*?</metadata>\n|<!--.*?-->\n', "", drawing, flags=re.DOTALL
    )
    drawing = re.sub(r'(?<= d=")[^"]*', lambda found: re.sub(r"\s*([A-Za-z])\s*", r"\1", found[0]), drawing)
    drawing = re.sub(r'(?<= style=")[^"]*', lambda found: re.sub(r"([:;]) ", r"\1", found[0]), drawing)
    referred = set(re.findall(r"#([\w.]+)", drawing))
    drawing = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in referred else "", drawing)
    if fonts := re.search(r"font-family:([^;\"]*);", drawing):
        drawing = drawing.replace(fonts[0], "").replace("<svg ", f'<svg font-family="{fonts[1]}" ', 1)
    return re.sub(r'(?<=;base64,)[^"]+', lambda found: b64encode(_with_palette(b64decode(found[0]))).decode(), drawing)


def _with_palette(png: bytes) -> bytes:
    """The PNG of see-through lines with a palette; one without transparency is a map whose every colour is a value, and stays."""
    picture, found = Image.open(io.BytesIO(png)).convert("RGBA"), io.BytesIO()
    if picture.getchannel("A").getextrema() == (255, 255):
        return png
    picture.quantize(PALETTE).save(found, format="PNG", optimize=True)
    return min(png, found.getvalue(), key=len)
