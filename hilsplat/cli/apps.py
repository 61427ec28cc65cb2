"""The command and its groups; the other modules of this package add the subcommands."""

import typer

app = typer.Typer(
    help="Turn photographs into a 3D Gaussian scene that answers text queries at three semantic levels.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
world_app = typer.Typer(help="Make and inspect scenes of the synthetic world.", no_args_is_help=True)
models_app = typer.Typer(help="Get, list, check, split and train models (SAM, CLIP).", no_args_is_help=True)
datasets_app = typer.Typer(help="List, check and export published data sets.", no_args_is_help=True)
cache_app = typer.Typer(help="Show or prune the caches of a results folder.", invoke_without_command=True)
app.add_typer(world_app, name="world")
app.add_typer(models_app, name="models")
app.add_typer(datasets_app, name="datasets")
app.add_typer(cache_app, name="cache")
