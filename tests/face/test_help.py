"""asim --help answers at once, because nothing heavy is imported for it."""

import json
import os
import subprocess
import sys

import pytest

# typer itself reads the parameters of a command with pydantic; ours, which build dozens of schemas, must not be added.
HEAVY = (
    "torch",
    "numpy",
    "httpx",
    "api_schemas",
    "service",
    "workers",
    "matplotlib",
    "PIL",
    "uvicorn",
    "sqlalchemy",
    "gymnasium",
)
COMMANDS: list[list[str]] = [
    [],
    ["project"],
    ["project", "create"],
    ["key"],
    ["db"],
    ["policy"],
    *(["policy", name] for name in ("train", "list")),
    *(["db", name] for name in ("upgrade", "copy")),
    *(["key", name] for name in ("create", "list", "revoke")),
    *(
        [name]
        for name in (
            "serve",
            "worker",
            "scheduler",
            "alive",
            "demo",
            "collect",
            "import",
            "export",
            "acquire",
            "label",
            "round",
            "error",
        )
    ),
    *([name] for name in ("jobs", "cancel", "events", "doctor", "backup", "restore", "gc")),
]


PROGRAM = """
import contextlib, io, json, sys
from asim.cli import main
commands, heavy = map(json.loads, sys.argv[1:])
told = []
for command in commands:
    sys.argv, printed = ["asim", *command, "--help"], io.StringIO()
    with contextlib.redirect_stdout(printed):
        try:
            main()
        except SystemExit as end:
            assert end.code == 0, end.code
    told.append((printed.getvalue(), [name for name in heavy if name in sys.modules]))
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def told() -> dict[str, tuple[str, list[str]]]:
    """By command: its help, and what of HEAVY is imported by then; what one command imports, all after it have."""
    argv = [sys.executable, "-c", PROGRAM, json.dumps(COMMANDS), json.dumps(HEAVY)]
    printed = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    return dict(zip(map(" ".join, COMMANDS), json.loads(printed), strict=True))


@pytest.mark.parametrize("command", [" ".join(command) for command in COMMANDS])
def test_help_imports_nothing_heavy(command: str, told: dict[str, tuple[str, list[str]]]) -> None:
    printed, heavy = told[command]
    assert f"Usage: asim {command}".strip() in printed
    assert heavy == []


@pytest.fixture(scope="module")
def bare() -> float:
    """Seconds that the help of a typer program takes which does nothing: machines differ, the ratio does not."""
    program = "import typer\napp = typer.Typer()\napp.command()(lambda count=1: None)\napp()"
    return min(_seconds([sys.executable, "-c", program, "--help"]) for _ in range(3))


@pytest.mark.parametrize("command", [[], ["serve"], ["acquire"]], ids=" ".join)
def test_help_takes_a_small_multiple_of_the_time_of_typer_alone(command: list[str], bare: float) -> None:
    assert min(_seconds([sys.executable, "-m", "asim", *command, "--help"]) for _ in range(3)) < 4 * bare


def test_the_top_help_needs_no_pydantic() -> None:
    program = "import sys, asim.cli; print('pydantic' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "False\n"
    )


def test_importing_asim_imports_nothing_heavy_but_names_the_client() -> None:
    program = (
        f"import asim, sys; print([name for name in {HEAVY!r} if name in sys.modules]); "
        "print(asim.Client.__module__, asim.NotFound.__mro__[1].__name__)"
    )
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert printed.splitlines() == ["[]", "asim.client ServiceError"]


def _seconds(argv: list[str]) -> float:
    """Processor time, which is what a command takes on a machine that does nothing else."""
    with subprocess.Popen(argv, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return usage.ru_utime + usage.ru_stime
