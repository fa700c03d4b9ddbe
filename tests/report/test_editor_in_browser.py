"""The editor in headless Chromium: off and on, a proposal by two clicks, solve, undo, reload; and a hostile page."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from posegraph_slam.pipeline.edits import read_edits
from posegraph_slam.report.edit_server import EditServer

STATE = "document.getElementById('edit-state').textContent"
DONE = "window.editor && !editor.busy"


def press(page: Any, button: str) -> None:
    page.run(f"document.getElementById('{button}').click(), 1")
    page.wait(DONE)
    page.settle()


def counts(page: Any) -> list[int]:
    """Number of closures shown as on, as off, and of candidates shown as rejected."""
    return page.run(
        "[report.map.edges.filter(e => e.layer === 'loops' && !e.off).length,"
        " report.map.edges.filter(e => e.layer === 'loops' && e.off).length,"
        " report.map.edges.filter(e => e.layer === 'rejected').length]"
    )


def test_closures_are_edited_solved_and_undone(browser: Any, server: EditServer) -> None:
    page = browser.open(server.address, height=1200)
    page.wait(DONE)
    on, off, rejected = counts(page)
    assert off == 0
    assert page.run("document.getElementById('edit-switch').disabled")
    page.run("report.select(report.map.edges.findLast(e => e.layer === 'loops')), 1")
    pair = page.run("[report.map.selected.i, report.map.selected.j]")
    press(page, "edit-switch")
    assert counts(page) == [on - 1, 1, rejected]
    assert page.run("document.getElementById('edit-list').children.length") == 1
    press(page, "edit-solve")
    assert "Solved in" in page.run(STATE)
    assert counts(page) == [on - 1, 0, rejected + 1]

    # a reload keeps the edits, and its address works once more
    first = page.run("location.href")
    page.go(first)
    page.wait(DONE)
    assert page.run("location.href") != first
    assert counts(page) == [on - 1, 0, rejected + 1]

    # two clicks on the map propose the neighbour of the closure that was there
    page.run("document.getElementById('map').scrollIntoView({behavior: 'instant'}), 1")
    press(page, "edit-propose")
    for node in (pair[0], pair[1] - 1):
        page.run(
            f"report.map.view.scale = 400, report.map.centreOn(...['x', 'y'].map(a => report.map.nodes[a][{node}]))"
        )
        page.settle()
        box = page.run("report.map.canvas.getBoundingClientRect().toJSON()")
        page.click(box["left"] + box["width"] / 2, box["top"] + box["height"] / 2)
    page.wait(f"({DONE}) && /^(Added|Refused|There)/.test({STATE})")
    assert page.run(STATE).startswith("Added: ")
    assert counts(page) == [on, 0, rejected + 1]
    press(page, "edit-solve")
    assert counts(page) == [on, 0, rejected + 1]
    assert page.run("report.map.edges.filter(e => e.kind === 'manual' && e.sigma !== null).length") == 1

    press(page, "edit-undo")
    press(page, "edit-undo")
    assert counts(page) == [on, 1, rejected]
    press(page, "edit-solve")
    assert counts(page) == [on, 0, rejected]
    assert not (server.session.folder / "edits.toml").exists()
    assert page.run("document.getElementById('edit-undo').disabled")
    assert page.complaints() == []


def test_editing_works_by_keyboard(browser: Any, server: EditServer) -> None:
    page = browser.open(server.address)
    page.wait(DONE)
    page.run("document.getElementById('canvas').focus(), 1")
    page.key("n")
    page.key("Delete", code=46)
    page.wait(f"({DONE}) && editor.state.edits.length === 1")
    assert len(read_edits(server.session.folder / "edits.toml")) == 1
    page.run("document.getElementById('edit-undo').focus(), 1")
    page.key(" ", text=" ", code=32)
    page.wait(f"({DONE}) && editor.state.edits.length === 0")
    page.run("document.getElementById('edit-propose').focus(), 1")
    page.key(" ", text=" ", code=32)
    page.run("report.map.showAll(), document.getElementById('canvas').focus(), 1")
    page.key("Enter", text="\r", code=13)
    assert page.run("editor.picking.length") == 1
    page.key("Escape")
    assert page.run("editor.picking") is None
    assert page.complaints() == []


def test_refusals_are_told_on_the_page(browser: Any, server: EditServer) -> None:
    page = browser.open(server.address)
    page.wait(DONE)
    page.run("editor.propose(0, 1), 1")
    page.wait(f"({DONE}) && !{STATE}.startsWith('Registering')")
    assert "neighbours" in page.run(STATE)
    assert page.run("document.getElementById('edit-state').classList.contains('wrong')")
    # the status 422 is the only thing that the console notes
    assert all("422" in line for line in page.complaints())


def test_a_page_of_another_site_gets_nothing(browser: Any, server: EditServer) -> None:
    class Evil(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>evil</title>")

        def log_message(self, *_: object) -> None:
            pass

    target, source = server.session.content.stored.records[0].target, server.session.content.stored.records[0].source  # type: ignore[union-attr]
    body = f'{{\\"target\\": {target}, \\"source\\": {source}, \\"on\\": false}}'
    with ThreadingHTTPServer(("127.0.0.1", 0), Evil) as evil:
        thread = threading.Thread(target=evil.serve_forever, daemon=True)
        thread.start()
        page = browser.open(f"http://127.0.0.1:{evil.server_port}/")
        tries = [
            f"fetch('{server.origin}/api/switch', {{method: 'POST', body: \"{body}\"}})",
            f"fetch('{server.origin}/api/switch', {{method: 'POST', mode: 'no-cors', body: \"{body}\"}})",
            f"fetch('{server.origin}/api/switch', {{method: 'POST', body: \"{body}\", headers: "
            f"{{'X-PSG-Token': '{server.call_token}', 'Content-Type': 'application/json'}}}})",
            f"fetch('{server.address}')",
            f"fetch('{server.address}', {{mode: 'no-cors'}})",
        ]
        for attempt in tries:
            got = page.run(f"{attempt}.then(r => r.text()).catch(e => 'failed: ' + e.name)")
            assert got in ("", "failed: TypeError"), attempt
        evil.shutdown()
        thread.join()
    assert not (server.session.folder / "edits.toml").exists()
    good = browser.open(server.address)
    good.wait(DONE)
