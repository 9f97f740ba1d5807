"""``difflpv probes``: light probes, one file for each of its own subcommands."""

from __future__ import annotations

import argparse
import textwrap
from importlib import import_module
from typing import Any

__all__ = ["SUBCOMMANDS", "add_parser"]

SUBCOMMANDS = ("targets", "place", "evaluate", "show", "export")


def add_parser(subparsers: Any) -> None:
    """Add the group with its subcommands."""
    parser = subparsers.add_parser(
        "probes",
        help="light probes: path-trace their targets, place, judge, draw and export them",
        description=textwrap.fill("Light probes. 'difflpv probes COMMAND --help' explains a command.", 100),
        epilog="example:\n  difflpv probes export --help",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name in SUBCOMMANDS:
        import_module(f"difflpv.cli.probes.{name}").add_parser(commands)
