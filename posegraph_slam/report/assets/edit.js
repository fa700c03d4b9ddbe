// Editing: every change is a call to the server that the page came from; the map shows what is off, new, and solved.
const BY_HAND = "switched off by hand";

class Editor {
  constructor(report) {
    this.report = report;
    const { token, next, state } = read("data-editor");
    this.token = token;
    // the address in the bar is spent: the next one makes a reload work
    history.replaceState(null, "", `/?token=${next}`);
    this.picking = null;
    this.busy = false;
    this.connect();
    this.show(state);
    this.tell(state.solved ? "Choose a closure on the map, or propose one." : "There are edits that are not solved yet.");
  }

  connect() {
    const report = this.report;
    report.onSelect = () => this.refresh();
    report.onPick = node => this.pick(node);
    byId("edit-switch").addEventListener("click", () => this.switchSelected());
    byId("edit-propose").addEventListener("click", () => this.startPicking(!this.picking));
    byId("edit-undo").addEventListener("click", () => this.ask("undo", {}, "Taken back."));
    byId("edit-solve").addEventListener("click", () => this.solve());
    byId("edit-save").addEventListener("click", () => this.save());
    byId("canvas").addEventListener("keydown", event => {
      if (event.key === "Escape") this.startPicking(false);
      if (event.key === "Enter" && this.picking) this.pickNearMiddle();
      if (event.key === "Delete" && !byId("edit-switch").disabled) this.switchSelected();
    });
  }

  // Sends one call; what goes wrong is told, and null returned.
  async call(name, body = {}) {
    if (this.busy) return null;
    this.busy = true;
    this.refresh();
    try {
      const answer = await fetch(`/api/${name}`, {
        method: "POST", headers: { "Content-Type": "application/json", "X-PSG-Token": this.token }, body: JSON.stringify(body), credentials: "omit", cache: "no-store",
      });
      const value = await answer.json();
      if (!answer.ok) throw new Error(value.error || `status ${answer.status}`);
      return value;
    } catch (error) {
      this.tell(error instanceof TypeError ? "psg edit is not running any more." : error.message, true);
      return null;
    } finally {
      this.busy = false;
      this.refresh();
    }
  }

  async ask(name, body, done) {
    const state = await this.call(name, body);
    if (!state) return;
    this.show(state);
    this.tell(`${done} Solve again to see what it gives.`);
  }

  tell(words, wrong = false) {
    byId("edit-state").textContent = words;
    byId("edit-state").classList.toggle("wrong", wrong);
  }

  // Marks what is off, and adds what is new and not yet solved to the map.
  show(state) {
    this.state = state;
    const map = this.report.map, key = (i, j) => `${i} ${j}`;
    const pairs = list => new Set(list.map(([i, j]) => key(i, j)));
    const off = pairs(state.off), added = pairs(state.added);
    const solvedOff = pairs(state.solved_off), solvedAdded = pairs(state.solved_added);
    map.edges = map.edges.filter(edge => !edge.unsolved);
    for (const edge of map.edges) {
      const pair = key(edge.i, edge.j);
      edge.switched = edge.reason === BY_HAND && solvedOff.has(pair);
      if (edge.switched) {
        const on = !off.has(pair);
        Object.assign(edge, on ? { layer: "loops", group: `kind-${edge.kind}` } : { layer: "rejected", group: null });
      } else if (edge.layer === "loops") {
        edge.off = off.has(pair) || (solvedAdded.has(pair) && !added.has(pair));
        if (solvedAdded.has(pair)) added.delete(pair);
      }
    }
    for (const pair of added) {
      const [i, j] = pair.split(" ").map(Number);
      map.edges.push({ i, j, kind: "manual", sigma: null, accepted: true, reason: "", layer: "loops", group: null, moved_m: null, matched: null, unsolved: true });
    }
    byId("edit-list").replaceChildren(...state.edits.map(words => make("li", {}, words)));
    this.report.buildLayers();
    this.report.buildLegend();
    this.refresh();
    map.redraw();
  }

  refresh() {
    if (!this.state) return;
    const edge = this.report.map.selected, button = byId("edit-switch"), none = this.state.edits.length === 0;
    const closure = edge && edge.layer === "loops", refused = edge && edge.layer === "rejected";
    const off = refused && edge.switched;
    button.disabled = this.busy || !(closure || refused);
    button.textContent = refused && !off ? "Try again" : (closure && edge.off) || off ? "Switch on" : "Switch off";
    byId("edit-undo").disabled = this.busy || none;
    byId("edit-solve").disabled = this.busy || this.state.solved;
    byId("edit-save").disabled = this.busy || none;
    byId("edit-propose").disabled = this.busy;
  }

  switchSelected() {
    const edge = this.report.map.selected;
    if (!edge || this.busy) return;
    const body = { target: edge.i, source: edge.j };
    if (edge.layer === "rejected" && !edge.switched) this.propose(edge.i, edge.j);
    else if (edge.layer === "rejected" || edge.off) this.ask("switch", { ...body, on: true }, "Switched on.");
    else this.ask("switch", { ...body, on: false }, "Switched off.");
  }

  // --- proposing ---------------------------------------------------------------------------------------------------

  startPicking(wanted) {
    this.picking = wanted ? [] : null;
    this.report.map.marked = [];
    this.report.map.redraw();
    byId("edit-propose").setAttribute("aria-pressed", String(Boolean(wanted)));
    if (wanted) this.tell("Click two places of the path that are the same in truth, or move the map and press Enter on its middle.");
  }

  pickNearMiddle() {
    const map = this.report.map;
    this.pick(map.nodeAt(map.width / 2, map.height / 2, 1e9));
  }

  // Returns whether the click was for us.
  pick(node) {
    if (!this.picking) return false;
    if (node < 0) {
      this.tell("There is no keyframe near: zoom in and click on the path.", true);
      return true;
    }
    this.picking.push(node);
    this.report.map.marked = [...this.picking];
    this.report.map.redraw();
    if (this.picking.length === 1) {
      this.tell(`Scan ${number(this.report.scans[node])} is the first; now the second.`);
    } else {
      const [a, b] = this.picking;
      this.startPicking(false);
      this.propose(Math.min(a, b), Math.max(a, b));
    }
    return true;
  }

  async propose(target, source) {
    const map = this.report.map;
    map.marked = [target, source];
    map.redraw();
    this.tell("Registering …");
    const found = await this.call("propose", { target, source });
    map.marked = [];
    map.redraw();
    if (!found) return;
    if (!found.possible) {
      this.tell(`Refused: ${found.reason}.`, true);
      return;
    }
    const evidence = `${Math.min(100, Math.round(100 * found.matched))} % of the points match, residual ${found.rmse_mm} mm, ${found.moved_m} m from the estimate`;
    if (found.surprise && !confirm(`The scans match (${evidence}), but the closure ${found.surprise}. Add it all the same?`)) {
      this.tell(`Not added: it ${found.surprise}.`);
      return;
    }
    await this.ask("add", {}, `Added: ${evidence}.`);
  }

  // --- solving -----------------------------------------------------------------------------------------------------

  async solve() {
    this.tell("Solving …");
    const started = performance.now(), answer = await this.call("solve");
    if (!answer) return;
    const home = { ...this.report.map.view };
    this.report.load(answer.layers);
    this.report.map.view = home;
    this.report.say(null);
    this.show(answer);
    const worst = Math.max(0, ...this.report.map.edges.filter(edge => edge.layer === "loops").map(edge => edge.sigma ?? 0));
    this.tell(`Solved in ${((performance.now() - started) / 1000).toFixed(1)} s (${words(answer.stop)}); the worst closure is ${worst.toFixed(1)} σ away.`);
  }

  async save() {
    this.tell("Saving a run with all its maps; this takes as long as psg optimize …");
    const answer = await this.call("save");
    if (answer) this.tell(`Saved: ${answer.saved}`);
  }
}

window.editor = new Editor(window.report);
