"""MkDocs hook: publish README.md and every project file that it links, without copies in docs/."""

import base64
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

RELATIVE_LINK = re.compile(r"\]\((?![a-z]+:)([^)\s#]+)")


def linked_files(project: Path, start: Path) -> set[Path]:
    """Return `start` and the project files reachable from it through relative links."""
    found, pending = {start}, [start]
    while pending:
        page = pending.pop()
        if page.suffix != ".md":
            continue
        targets = {(page.parent / link).resolve() for link in RELATIVE_LINK.findall(page.read_text("utf-8"))}
        new = {each for each in targets - found if each.is_relative_to(project) and each.is_file()}
        found |= new
        pending += new
    return found


class NotebookPage(File):
    """A notebook, published as a page."""

    def is_documentation_page(self) -> bool:
        return True


def notebook_files(project: Path, path: str, config: MkDocsConfig) -> Iterator[File]:
    """Yield the page of a notebook (cells and saved outputs as Markdown) and its pictures."""
    parts: list[str] = []
    stem = PurePosixPath(path).with_suffix("")
    for number, cell in enumerate(nbformat.read(project / path, as_version=4).cells):
        parts.append(cell.source if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{stem}-{number}.png"
                pixels = base64.b64decode(data["image/png"])
                yield File.generated(config, picture, content=pixels)
                parts.append(f"![output of the cell above]({PurePosixPath(picture).name})")
            elif text := output.get("text") or data.get("text/plain"):
                parts.append(f"```text\n{text.rstrip()}\n```")
    yield NotebookPage.generated(config, path, content="\n\n".join(parts))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace the files found in docs/ with README.md and the files reachable from it.

    Each file keeps its path in the project, so relative links work on the site as they do in the repository.
    """
    project = Path(config.docs_dir).resolve().parent
    theme_files = [each for each in files if each.src_dir != config.docs_dir]
    published: list[File] = []
    for path in sorted(each.relative_to(project) for each in linked_files(project, project / "README.md")):
        if path.suffix == ".ipynb":
            published += notebook_files(project, path.as_posix(), config)
        else:
            published.append(File(path.as_posix(), str(project), config.site_dir, config.use_directory_urls))
    return Files([*theme_files, *published])
