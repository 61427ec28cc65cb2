"""Overviews of released and installed models, and checks of installed ones."""

from hilsplat.base.errors import HilsplatError
from hilsplat.embed.model_check import check_model
from hilsplat.models.store import (
    RECOMMENDED,
    RELEASES,
    broken_models,
    present_models,
    real_model,
    user_models,
)

COLUMNS = "{:<24} {:<5} {:>8}  {:<11} {:<11} {}"


def models_table() -> str:
    """Return a table of released and installed models, with those that are used for photographs."""
    here = {model.folder.name: model for model in present_models()}
    chosen = {str(real_model(family)) for family in ("sam", "clip")}

    def state(name: str) -> str:
        if name not in here:
            return "incomplete" if (user_models() / f".{name}.part").is_dir() else ""
        return "in use" if str(here[name].folder) in chosen else "installed"

    lines = [COLUMNS.format("name", "kind", "MB", "licence", "", "use")]
    for release in RELEASES:
        kind, use = release.family.upper(), release.use
        if release.name in RECOMMENDED:
            use += " (recommended)"
        cells = (release.name, kind, release.megabytes, release.licence, state(release.name), use)
        lines.append(COLUMNS.format(*cells).rstrip())
    for name, model in here.items():
        if name in {release.name for release in RELEASES}:
            continue
        files = [path for path in model.folder.rglob("*") if path.is_file()]
        size = f"{sum(path.stat().st_size for path in files) / 1e6:.0f}"
        use = "the synthetic world only" if model.embedded else ""
        lines.append(COLUMNS.format(name, model.family.upper(), size, "", state(name), use).rstrip())
    lines += [
        "",
        "hilsplat models get NAME, or owner/name on the hub; without a name, the recommended pair",
        f"Models are stored in {user_models()}; those in a project's models/ take precedence.",
    ]
    return "\n".join(lines)


def check_models() -> tuple[str, int]:
    """Return the report of `check_model` on every installed model, and the number of broken models."""
    texts, num_failed = [], 0
    for folder in [*(model.folder for model in present_models()), *broken_models()]:
        try:
            texts.append(check_model(folder))
        except HilsplatError as error:
            texts.append(f"{folder} does not work: {error}")
            num_failed += 1
    return "\n\n".join(texts) or "no model is installed", num_failed
