"""The command line: `python -m blastjax` breaks walls, `... fracture` makes assets.

Each command is one entry of COMMANDS: its help, the options that it adds to a parser,
and the function that runs it. Without a name the first one runs.
"""

import argparse
import sys
from collections.abc import Sequence

from blastjax.commands import breach, fracture
from blastjax.commands.options import Command

COMMANDS = {
    "breach": Command(breach.HELP, breach.options, breach.run),
    "fracture": Command(fracture.HELP, fracture.options, fracture.run),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return the exit code; bad options exit with 2."""
    words = list(sys.argv[1:] if argv is None else argv)
    name = next(iter(COMMANDS))
    program = "python -m blastjax"
    others = [other for other in COMMANDS if other != name]
    about = f"Other commands, each with its own --help: {', '.join(others)}."
    if words and words[0] in COMMANDS:
        name = words.pop(0)
        program, about = f"{program} {name}", ""
    command = COMMANDS[name]
    parser = argparse.ArgumentParser(
        prog=program,
        description=command.help,
        epilog=about,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    command.options(parser)
    args = parser.parse_args(words)
    try:
        return command.run(args, parser)
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return 130
    except ImportError as error:
        print(f"blastjax: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
