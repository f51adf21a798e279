"""The README's walk-throughs, run from its own text against an `asim serve` of their own."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"


def block(language: str) -> str:
    """The one block of that language in the README."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", README.read_text(), re.MULTILINE | re.DOTALL)
    return str(found)


def run(argv: list[str], url: str, folder: Path) -> str:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "ASIM_URL": url}
    done = subprocess.run(argv, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_curl_walk_through_works_as_printed_and_its_error_falls(url: str, tmp_path: Path) -> None:
    printed = run(["bash", "-e", "-c", block("bash")], url, tmp_path)
    losses = {
        int(labels): float(loss) for labels, loss in re.findall(r"^(\d+) labels: test loss ([\d.]+)$", printed, re.M)
    }
    assert list(losses) == [60, 120]
    assert losses[120] < losses[60]


@pytest.mark.slow
def test_the_python_walk_through_works_as_printed_and_its_error_falls(url: str, tmp_path: Path) -> None:
    program = block("python").replace("http://127.0.0.1:8000", url)
    printed = run([sys.executable, "-c", program], url, tmp_path)
    losses = [float(loss) for loss in re.findall(r"\(\d+, ([\d.]+)\)", printed)]
    assert len(losses) == 2
    assert losses[1] < losses[0]


def test_the_settings_table_names_every_setting_with_its_default() -> None:
    from service.settings import Settings

    rows = dict(re.findall(r"^\| `(ASIM_\w+)` \| `?([^|`]*?)`? \|", README.read_text(), re.MULTILINE))
    named = {f"ASIM_{name.upper()}": field.default for name, field in Settings.model_fields.items()}
    assert set(rows) == set(named)
    numbers = {name: value for name, value in named.items() if isinstance(value, int | float)}
    assert {name: json.loads(rows[name]) for name in numbers} == numbers
