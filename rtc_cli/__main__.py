"""The console script `rtc` and `python -m rtc_cli`: answers Ctrl-C even while modules load."""

import sys


def main() -> None:
    """Run the command line and exit with its code; 130 when interrupted."""
    try:
        from rtc_cli.cli.app import run

        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        print("rtc: interrupted; run again to resume", file=sys.stderr)
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
