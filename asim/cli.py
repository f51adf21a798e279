"""The command line. Nothing heavy is imported before a command runs: every --help answers at once."""

import sys

import typer

from asim.commands import keys, labeling, policies, processes, projects, recordings, upkeep, work
from asim.commands.console import explain

app = typer.Typer(
    name="asim",
    help="Find the few action-free segments whose labels help a robot world model most.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command("serve")(processes.serve)
app.command("worker")(processes.worker)
app.command("scheduler")(processes.scheduler)
app.command("alive")(processes.alive)
app.command("demo")(processes.demo)
app.add_typer(projects.app, name="project", help="Create, list, show and change projects.")
app.add_typer(keys.app, name="key", help="Make, list and revoke API keys, on the service's own database.")
app.add_typer(policies.app, name="policy", help="Train policies of robot tasks, and list them.")
app.command("collect")(projects.collect)
app.command("import")(recordings.import_files)
app.command("export")(recordings.export_pictures)
app.command("acquire")(labeling.acquire)
app.command("label")(labeling.label)
app.command("round")(labeling.start_round)
app.command("error")(labeling.model_error)
app.command("jobs")(work.jobs)
app.command("cancel")(work.cancel)
app.command("events")(work.events)
app.command("doctor")(upkeep.doctor)
app.command("backup")(upkeep.backup)
app.command("restore")(upkeep.restore)
app.command("gc")(upkeep.gc)
app.add_typer(upkeep.db, name="db", help="The database itself: its schema, and its rows in another database.")


def main() -> None:
    """Run one command; what goes wrong is one sentence on stderr and exit status 1."""
    try:
        app()
    except Exception as error:
        sentence = explain(error)
        if sentence is None:
            raise
        typer.echo(f"asim: {sentence}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
