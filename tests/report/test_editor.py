"""The editor's session and its server: what it does, and all that it refuses."""

from __future__ import annotations

import html
import http.client
import json
import shutil
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from posegraph_slam.cli.application import app
from posegraph_slam.errors import InputError
from posegraph_slam.pipeline.edits import read_edits
from posegraph_slam.pose_graph.g2o import read_g2o
from posegraph_slam.report.edit_server import BODY_MAX, TOKEN_HEADER, EditServer
from posegraph_slam.report.edit_session import EditSession


@pytest.fixture
def folder(small_run: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "run"
    shutil.copytree(small_run, copy)
    return copy


def closures(session: EditSession) -> list[tuple[int, int]]:
    """Keyframes of the accepted closures."""
    stored = session.content.stored
    assert stored is not None
    return [(stored.records[row].target, stored.records[row].source) for row in stored.record_of.tolist()]


# --- the session -----------------------------------------------------------------------------------------------------


def test_edits_are_kept_undone_and_taken_up_again(folder: Path) -> None:
    session = EditSession(folder)
    first, second = closures(session)[:2]
    assert session.state()["solved"] is True
    session.switch(*first, on=False)
    state = session.switch(second[1], second[0], on=False)
    assert state["off"] == sorted([[*first], [*second]])
    assert state["solved"] is False
    assert len(read_edits(folder / "edits.toml")) == 2
    assert EditSession(folder).state()["off"] == state["off"]
    assert session.undo()["off"] == [[*first]]
    session.undo()
    assert not (folder / "edits.toml").exists()
    with pytest.raises(InputError, match="nothing to undo"):
        session.undo()


def test_solving_and_saving_equal_a_headless_replay(folder: Path, tmp_path: Path) -> None:
    session = EditSession(folder)
    pair = closures(session)[-1]
    for each in closures(session):
        session.switch(*each, on=False)
    bare = session.solve()
    assert not any(bare["layers"]["loops"]["accepted"])
    with pytest.raises(InputError, match="switch it on"):
        session.propose(*pair)
    session.switch(*pair, on=True)
    solved = session.solve()
    assert solved["solved"] is True
    assert sum(solved["layers"]["loops"]["accepted"]) == 1
    saved = Path(session.save()["saved"])
    assert saved == folder.with_name("run-edited")
    replayed = tmp_path / "replayed"
    line = ["optimize", str(folder), "--from", "graph", "--edits", str(folder / "edits.toml"), "-q"]
    assert CliRunner().invoke(app, [*line, "--out", str(replayed)], catch_exceptions=False).exit_code == 0
    files = {path.relative_to(saved) for path in saved.rglob("*") if path.is_file()}
    for name in sorted(files - {Path("run.json"), Path("report.html")}):
        assert (saved / name).read_bytes() == (replayed / name).read_bytes(), name
    stored = session.content.stored
    assert stored is not None
    np.testing.assert_allclose(stored.graph.poses, read_g2o(replayed / "graph.g2o").poses, atol=1e-15)
    (saved / "run.json").unlink()
    with pytest.raises(InputError, match="holds something else; move it away"):
        session.save()


def test_a_proposed_closure_is_registered_and_added(folder: Path) -> None:
    session = EditSession(folder)
    pair = closures(session)[-1]
    neighbour = (pair[0], pair[1] - 1)
    with pytest.raises(InputError, match="joined by one already"):
        session.propose(*pair)
    with pytest.raises(InputError, match="no proposal to add"):
        session.add()
    found = session.propose(*neighbour)
    assert found["possible"]
    assert found["matched"] > 0.4
    state = session.add()
    assert state["added"] == [[*neighbour]]
    closure = read_edits(folder / "edits.toml").edit[0].closure
    assert closure is not None
    assert closure.matched_fraction == pytest.approx(found["matched"], abs=0.01)
    layers = session.solve()["layers"]["loops"]
    at = layers["kinds"].index("manual")
    assert [(i, j) for i, j, kind in zip(layers["i"], layers["j"], layers["kind"], strict=True) if kind == at] == [
        neighbour
    ]
    stored = session.content.stored
    assert stored is not None
    xy = stored.graph.poses[:, :2, 2]
    far = int(np.argmax(np.linalg.norm(xy - xy[0], axis=1)))
    refused = session.propose(0, far)
    assert not refused["possible"]
    assert refused["reason"]
    with pytest.raises(InputError, match="no proposal to add"):
        session.add()


def test_runs_that_cannot_be_edited_are_named(folder: Path, tmp_path: Path) -> None:
    def error(*arguments: str) -> str:
        result = CliRunner().invoke(app, ["edit", "--no-browser", *arguments], catch_exceptions=False)
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1
        return result.stderr

    assert "is not a run directory" in error(str(tmp_path))
    (folder / "edits.toml").write_text("[[edit]]\naction = 'off'\ntarget_scan = 0\nsource_scan = 1\n")
    assert "edit 1: " in error(str(folder))
    (folder / "edits.toml").unlink()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert "choose another --port" in error(str(folder), "--port", str(taken.getsockname()[1]))
    (folder / "graph.g2o").unlink()
    assert "has no graph.g2o" in error(str(folder))


# --- the server ------------------------------------------------------------------------------------------------------


def ask(
    server: EditServer, method: str, target: str, headers: dict[str, str] | None = None, body: bytes | None = None
) -> tuple[int, dict[str, str], bytes]:
    """Send one request as it stands and return status, headers and body."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    connection.putrequest(method, target, skip_host=True, skip_accept_encoding=True)
    sent = {"Host": f"127.0.0.1:{server.server_port}", **(headers or {})}
    if body is not None:
        sent.setdefault("Content-Length", str(len(body)))
    for name, value in sent.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(body)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, dict(answer.getheaders()), content


def call(server: EditServer, name: str, body: object = None, **headers: Any) -> tuple[int, dict[str, Any]]:
    """Make a call as the page does, with some headers changed (None: left out), and return status and answer."""
    sent = {"Content-Type": "application/json", TOKEN_HEADER: server.call_token, "Origin": server.origin}
    sent |= {"Sec-Fetch-Site": "same-origin", **{key.replace("_", "-"): value for key, value in headers.items()}}
    content = body if isinstance(body, bytes) else json.dumps({} if body is None else body).encode()
    status, got, answer = ask(server, "POST", f"/api/{name}", {k: v for k, v in sent.items() if v is not None}, content)
    assert got["Content-Type"] == "application/json; charset=utf-8"
    assert answer.count(b"\n") == 1
    assert not any(name.lower().startswith("access-control") for name in got)
    return status, json.loads(answer)


def test_server_listens_on_this_machine_alone(server: EditServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.address.startswith(f"http://127.0.0.1:{server.server_port}/?token=")
    assert len(server.address.partition("=")[2]) >= 43  # 256 bits


def test_page_comes_once_for_a_token_and_brings_the_next(server: EditServer) -> None:
    target = server.address.removeprefix(server.origin)
    status, headers, page = ask(server, "GET", target, {"Sec-Fetch-Site": "none"})
    assert status == 200
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert "connect-src 'self'" in html.unescape(page.decode())
    assert (headers["Cache-Control"], headers["X-Frame-Options"]) == ("no-store", "DENY")
    assert (headers["Referrer-Policy"], headers["X-Content-Type-Options"]) == ("no-referrer", "nosniff")
    assert not {"Set-Cookie", "Access-Control-Allow-Origin"} & set(headers)
    status, _, answer = ask(server, "GET", target)
    assert status == 403
    assert server.call_token.encode() not in answer
    following = server.address.partition("=")[2]
    assert following.encode() in page
    assert ask(server, "GET", f"/?token={following}")[0] == 200


@pytest.mark.parametrize("target", ["/", "/?token=", "/?token=wrong", "/?token=%ff", "/?token=a&token=b", "/?Token=x"])
def test_page_is_refused_without_its_token(server: EditServer, target: str) -> None:
    before = server.address
    status, _, answer = ask(server, "GET", target)
    assert status == 403
    assert "start psg edit again" in json.loads(answer)["error"]
    assert server.address == before


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80"},
        {"Host": "127.0.0.1"},
        {"Host": "127.0.0.1:1"},
        {"Host": ""},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://127.0.0.1"},
        {"Sec_Fetch_Site": "cross-site"},
        {"Sec_Fetch_Site": "same-site"},
        {TOKEN_HEADER: None},
        {TOKEN_HEADER: ""},
        {TOKEN_HEADER: "wrong"},
        {TOKEN_HEADER: "w\xf6rong"},
    ],
    ids=lambda headers: "-".join(str(part) for item in headers.items() for part in item),
)
def test_calls_from_elsewhere_are_refused(server: EditServer, headers: dict[str, str]) -> None:
    status, answer = call(server, "undo", **headers)
    assert status == 403
    assert list(answer) == ["error"]


def test_page_is_refused_to_other_sites_and_hosts(server: EditServer) -> None:
    target = server.address.removeprefix(server.origin)
    for headers in ({"Host": "evil.example"}, {"Sec-Fetch-Site": "cross-site"}, {"Origin": "http://evil.example"}):
        assert ask(server, "GET", target, headers)[0] == 403
    assert server.address.endswith(target)


@pytest.mark.parametrize(
    "target",
    ["/run.json", "/../run.json", "/..%2frun.json", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/api/state",
     "/favicon.ico", "/static/../../etc/passwd"],
)  # fmt: skip
def test_no_file_can_be_read(server: EditServer, target: str) -> None:
    status, _, answer = ask(server, "GET", target, {TOKEN_HEADER: server.call_token})
    assert status == 404
    assert json.loads(answer) == {"error": "there is only one page"}
    sent = {TOKEN_HEADER: server.call_token, "Content-Type": "application/json"}
    if target != "/api/state":
        assert ask(server, "POST", target, sent, b"{}")[0] == 404


def test_bodies_that_are_too_large_or_no_json_are_refused(server: EditServer) -> None:
    assert call(server, "undo", b" " * (BODY_MAX + 1))[0] == 413
    assert call(server, "undo", b"", Content_Length="99999999999")[0] == 413
    assert call(server, "undo", b"", Content_Length="-1")[0] == 411
    assert call(server, "undo", b"", Content_Length="1e3")[0] == 411
    assert call(server, "undo", b"", Transfer_Encoding="chunked")[0] == 411
    assert call(server, "undo", Content_Type="text/plain")[0] == 415
    assert call(server, "undo", Content_Type=None)[0] == 415
    for body in (b"", b"{", b"[1]", b"\xff", b"[" * BODY_MAX):
        assert call(server, "undo", body)[0] == 400, body
    for body in ({}, {"target": 1}, {"target": 1, "source": "2", "on": True}, {"target": 1, "source": 2, "on": 1},
                 {"target": True, "source": 2, "on": True}, {"target": 1.0, "source": 2, "on": True}):  # fmt: skip
        status, answer = call(server, "switch", body)
        assert status == 400
        assert "must be" in answer["error"]
    assert ask(server, "GET", "/" + "a" * 600)[0] == 414
    assert call(server, "unknown")[0] == 404


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "HEAD", "TRACE", "BREW"])
def test_other_methods_are_refused_on_one_line(server: EditServer, method: str) -> None:
    status, headers, answer = ask(server, method, "/api/undo", {"Origin": "http://evil.example"})
    assert status == 501
    assert not any(name.lower().startswith("access-control") for name in headers)
    assert method == "HEAD" or json.loads(answer)["error"]


def test_wrong_requests_do_not_end_the_server(server: EditServer) -> None:
    for wrong in (b"\x00\x01\x02\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as client:
            client.sendall(wrong)
            client.shutdown(socket.SHUT_WR)
            client.recv(65536)
    assert call(server, "state")[0] == 200


def test_calls_work_and_errors_of_the_session_are_told(server: EditServer) -> None:
    target, source = closures(server.session)[0]
    status, state = call(server, "switch", {"target": target, "source": source, "on": False})
    assert status == 200
    assert state["off"] == [[target, source]]
    status, answer = call(server, "switch", {"target": 0, "source": 10**6, "on": False})
    assert (status, answer["error"]) == (422, "closure: keyframes 0 and 1000000 are not two of this run")
    assert call(server, "undo")[1]["off"] == []
    assert call(server, "undo")[0] == 422


def test_a_bug_is_told_on_one_line_without_its_traceback(
    server: EditServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(server.session, "solve", lambda: 1 / 0)
    status, answer = call(server, "solve")
    assert (status, answer) == (500, {"error": "a bug: the terminal shows where"})
    assert "ZeroDivisionError" in capsys.readouterr().err
