"""Known vulnerabilities of everything installed here, by pip-audit.

Some package mirrors tell of vulnerabilities only with a package's newest version. There the installed version is looked
up where it is the newest; of the others only those may go unaudited that something holds back, each for its reason.
"""

import sys
from dataclasses import dataclass
from typing import Any

import requests
from pip_audit._dependency_source import PipSource
from pip_audit._service import PyPIService

HELD = {
    "contourpy": "1.4 needs Python 3.12",
    "deprecated": "3.0 needs Python 3.12",
    "jsonschema-rs": "schemathesis needs it below 0.61; tests only",
    "mpmath": "sympy, which torch needs, takes it below 1.4",
    "mujoco": "robosuite 1.5.2 breaks from 3.10 on; robots only",
    "networkx": "3.7 needs Python 3.12",
    "numpy": "robosuite and ManiSkill need it below 2",
    "opencv-python-headless": "4.12 needs numpy 2; robots only",
    "python-dateutil": "celery 5.7.0 needs 2.9.0.post0 exactly",
    "scipy": "1.18 needs Python 3.12 and numpy 2",
    "torch": "a newer one is taken when the figures of docs/results.md are measured anew",
}


@dataclass(frozen=True)
class NewestToo:
    """A session that asks for a project where a mirror does not know the version."""

    session: requests.Session

    def get(self, url: str, timeout: int | None) -> requests.Response:
        """What is told of .../project/version/json, also where only .../project/json tells of that version."""
        answer = self.session.get(url, timeout=timeout)
        if answer.status_code != requests.codes.not_found:
            return answer
        project, version, _ = url.rsplit("/", 2)
        newest = self.session.get(f"{project}/json", timeout=timeout)
        return newest if newest.ok and newest.json()["info"]["version"] == version else answer


def audit() -> int:
    """Prints what was found and what could not be looked up; the number of things that need somebody."""
    service: Any = PyPIService(timeout=60)
    service.session = NewestToo(service.session)
    found, skipped, clean = [], [], 0
    for dependency, vulnerabilities in service.query_all(PipSource(skip_editable=True).collect()):
        found += [f"{dependency.name} {dependency.version}: {each.id}: {each.description}" for each in vulnerabilities]
        if dependency.is_skipped():
            skipped.append(dependency.canonical_name)
        elif not vulnerabilities:
            clean += 1
    unexplained = [name for name in skipped if name not in HELD and name != "asim"]
    print(*sorted(found), sep="\n")
    print(*(f"{name}: not looked up; it is not the newest: {HELD[name]}" for name in skipped if name in HELD), sep="\n")
    print(*(f"{name}: could not be looked up" for name in unexplained), sep="\n")
    print(f"{clean} packages have no known vulnerability, {len(found)} vulnerabilities were found")
    return len(found) + len(unexplained)


if __name__ == "__main__":
    sys.exit(1 if audit() else 0)
