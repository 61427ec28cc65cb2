# Functions of the rules.
def given(files):
    """Return an input function for files outside the results, whose paths get no prefix from a module."""

    def paths(wildcards):
        names = files(wildcards)
        return names if isinstance(names, str) else [local(name) for name in names]

    return paths


def picture(path, category, name, **labels):
    """Return a picture or table for the report."""
    caption = INSTALLED / "workflow/report" / f"{name}.rst"
    return report(path, caption=str(caption), category=category, **labels)


def scene_picture(name):
    path = f"<results>/figures/{{dataset}}/{{scene}}/{name}.webp"
    labels = {"figure": targets.PICTURES[name]}
    return picture(path, "Scenes", name, subcategory="{dataset}/{scene}", labels=labels)
