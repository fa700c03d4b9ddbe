"""`psg edit`."""

from __future__ import annotations

from typing import Annotated

import typer

from posegraph_slam.cli.arguments import Quiet, Verbose
from posegraph_slam.cli.reporting import Run


def edit(
    run: Run,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port on 127.0.0.1; 0, the default: a free one.")
    ] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address only; open no browser.")] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Switch closures of a run off or on, propose new ones, and solve again, in the browser.

    The page is served on this machine alone, until Ctrl-C. Changes are kept in RUN/edits.toml.
    """
    import contextlib
    import threading
    import webbrowser
    from shlex import quote

    from posegraph_slam.pipeline.run_directory import EDITS
    from posegraph_slam.report.edit_server import EditServer
    from posegraph_slam.report.edit_session import EditSession

    with EditServer(EditSession(run), port=port) as server:
        typer.echo(f"editor:   {server.address}")
        if not quiet:
            typer.echo("the address works once; Ctrl-C ends", err=True)
        if not no_browser:
            # a browser in the terminal returns only when it is left: the server must answer it meanwhile
            threading.Thread(target=webbrowser.open, args=(server.address,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
        edits = run / EDITS
        if edits.is_file() and not quiet:
            typer.echo(f"\nedits:    {edits}")
            typer.echo(f"replay:   psg optimize {quote(str(run))} --from graph --edits {quote(str(edits))}")
