"""MkDocs hook: publish README.md and every project file that it links, without copies in docs/."""

import re
from pathlib import Path

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


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace the files found in docs/ with README.md and the files reachable from it.

    Each file keeps its path in the project, so relative links work on the site as they do in the repository.
    """
    project = Path(config.docs_dir).resolve().parent
    theme_files = [each for each in files if each.src_dir != config.docs_dir]
    paths = sorted(
        path.relative_to(project).as_posix() for path in linked_files(project, project / "README.md")
    )
    pages = [File(path, str(project), config.site_dir, config.use_directory_urls) for path in paths]
    return Files([*theme_files, *pages])
