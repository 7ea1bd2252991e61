"""JSON output of the commands."""

import typer


def print_json(value: object) -> None:
    """Writes a value to stdout, indented; dataclasses become objects."""
    import msgspec

    typer.echo(msgspec.json.format(msgspec.json.encode(value), indent=2).decode())
