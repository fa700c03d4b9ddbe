// Fills the map from the page's data, and connects it to controls, pointer and keyboard.
const PAN_PX = 60, ZOOM_STEP = 1.4;
const read = id => JSON.parse(document.getElementById(id).textContent);
const byId = id => document.getElementById(id);
const words = name => name.replaceAll("_", " ");
const number = value => value.toLocaleString("en").replaceAll(",", "\u2009");

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

class Report {
  constructor() {
    this.map = new RunMap(byId("canvas"));
    this.pointers = new Map();
    this.touched = false;
    this.onPick = null;
    this.load(read("data-layers"));
    this.buildLayers();
    this.buildLegend();
    this.connectPointer();
    this.connectKeyboard();
    this.connectButtons();
    this.map.onView = () => this.drawScale();
    this.say(null);
    this.map.resize();
  }

  // Takes over what the page, or the editor after solving again, knows of the run.
  load(layers) {
    const map = this.map;
    this.layers = layers;
    map.home = layers.home;
    for (const name of ["occupancy", "texture"]) {
      if (layers[name]) map.setImage(name, layers[name], name === "occupancy");
      else delete map.images[name];
    }
    const count = layers.paths.length;
    map.paths = layers.paths.map((path, k) => {
      const rank = 3 - count + k;
      return {
        ...RunMap.positions(path.mm), name: path.name, layer: `path-${rank}`, colour: `path-${rank}`,
        width: [1.6, 1.6, 2.2][rank], dash: rank === 0 ? [7, 5] : [],
      };
    });
    if (layers.nodes) {
      map.nodes = RunMap.positions(layers.nodes.mm);
      let scan = 0;
      this.scans = layers.nodes.scan.map(step => (scan += step));
    }
    map.edges = [...this.overlapEdges(layers.overlaps), ...this.loopEdges(layers.loops)];
    map.selected = null;
    map.marked = [];
  }

  overlapEdges(overlaps) {
    if (!overlaps) return [];
    return overlaps.i.map((i, k) => ({ i, j: overlaps.j[k], kind: "overlap", sigma: overlaps.sigma[k], accepted: true, layer: "overlaps" }));
  }

  loopEdges(loops) {
    if (!loops) return [];
    return loops.i.map((i, k) => {
      const accepted = loops.accepted[k] === 1, kind = loops.kinds[loops.kind[k]];
      return {
        i, j: loops.j[k], kind, accepted, sigma: loops.sigma[k], reason: loops.reasons[loops.reason[k]], layer: accepted ? "loops" : "rejected",
        group: accepted ? `kind-${kind}` : null, moved_m: loops.moved_m[k], moved_deg: loops.moved_deg[k], matched: loops.matched[k], rmse_mm: loops.rmse_mm[k],
      };
    });
  }

  // One checkbox a layer: those that hide the rest start switched off.
  buildLayers() {
    const box = byId("layers"), map = this.map, kept = { ...map.visible };
    const add = (layer, label, on, sign, tally) => {
      const input = make("input", { type: "checkbox", id: `layer-${layer}` });
      input.checked = map.visible[layer] = layer in kept ? kept[layer] : on;
      input.addEventListener("change", () => {
        map.visible[layer] = input.checked;
        map.redraw();
      });
      const parts = [input];
      if (sign) parts.push(sign);
      parts.push(make("span", {}, label));
      if (tally !== undefined) parts.push(make("span", { class: "tally" }, number(tally)));
      box.append(make("label", {}, ...parts));
    };
    for (const old of box.querySelectorAll("label")) old.remove();
    if (map.images.occupancy) add("occupancy", "occupancy", true);
    if (map.images.texture) add("texture", "texture", true);
    for (const path of map.paths) {
      add(path.layer, path.name, path.layer === "path-2", this.sign(path.colour, path.dash.length > 0));
    }
    if (map.edges.length || this.layers.loops) {
      const tally = layer => map.edges.filter(edge => edge.layer === layer).length;
      add("loops", "loop closures", true, null, tally("loops"));
      if (this.layers.overlaps && this.layers.overlaps.i.length) add("overlaps", "overlaps", false, this.sign("overlap"), this.layers.overlaps_total);
      add("rejected", "rejected", false, this.sign("rejected"), tally("rejected") + (this.layers.loops_left_out || 0));
    }
  }

  sign(colour, dashed = false) {
    const line = make("span", { class: dashed ? "line dashed" : "line", "aria-hidden": "true" });
    line.style.borderTopColor = `var(--${colour})`;
    return line;
  }

  buildLegend() {
    const box = byId("legend"), map = this.map;
    const loops = map.edges.filter(edge => edge.layer === "loops");
    byId("colours").hidden = !map.edges.length;
    box.replaceChildren();
    if (map.colourBy === "chi2") {
      box.append(make("div", { class: "ramp" }), make("div", { class: "ends" }, make("span", {}, "0"), make("span", {}, "distance from the solution"), make("span", {}, "3 σ")));
      return;
    }
    for (const kind of [...new Set(loops.map(edge => edge.kind))]) {
      const input = make("input", { type: "checkbox", id: `kind-${kind}` });
      const group = `kind-${kind}`;
      input.checked = map.visible[group] !== false;
      input.addEventListener("change", () => {
        map.visible[group] = input.checked;
        map.redraw();
      });
      box.append(make("label", {}, input, this.sign(kind), words(kind), make("span", { class: "tally" }, number(loops.filter(edge => edge.kind === kind).length))));
    }
  }

  // --- words -------------------------------------------------------------------------------------------------------

  describe(edge) {
    const scans = `scans ${number(this.scans[edge.i])} and ${number(this.scans[edge.j])}`;
    if (edge.layer === "overlaps") return ["Overlap", ` of ${scans}: ${edge.sigma.toFixed(1)} σ from the solution.`];
    const kind = words(edge.kind);
    const measured = [];
    if (edge.matched) measured.push(`${Math.min(100, Math.round(100 * edge.matched))} % of the points match`);
    if (edge.matched && edge.rmse_mm !== null) measured.push(`residual ${edge.rmse_mm} mm`);
    if (edge.accepted && edge.moved_m !== null) measured.push(`it lay ${edge.moved_m.toFixed(2)} m and ${edge.moved_deg.toFixed(1)}° from the estimate when it was found`);
    const evidence = measured.length ? ` ${measured.join(", ")}.` : "";
    if (!edge.accepted) return [`Rejected: ${edge.reason}.`, ` Candidate (${kind}) between ${scans}.${evidence}`];
    const sigma = edge.sigma === null ? "" : `, ${edge.sigma.toFixed(1)} σ from the solution`;
    return ["Closure", ` (${kind}) between ${scans}${sigma}.${evidence}`];
  }

  say(edge, hint = "Point at a loop edge, or press N on the map, to read what it says.") {
    const box = byId("details");
    box.classList.toggle("chosen", Boolean(edge));
    if (!edge) {
      box.replaceChildren(hint);
      return;
    }
    const [tag, rest] = this.describe(edge);
    box.replaceChildren(make("span", { class: "tag" }, tag), rest);
  }

  select(edge, centre = false) {
    this.map.selected = edge;
    this.say(edge);
    const { x, y } = this.map.nodes;
    if (edge && centre) this.map.centreOn((x[edge.i] + x[edge.j]) / 2, (y[edge.i] + y[edge.j]) / 2);
    this.map.redraw();
    if (this.onSelect) this.onSelect(edge);
  }

  // Steps through the visible edges, the worst first.
  step(direction) {
    const shown = this.map.edges.filter(edge => this.map.shown(edge));
    if (!shown.length) return;
    shown.sort((a, b) => (b.sigma ?? -1) - (a.sigma ?? -1) || a.j - b.j);
    const at = shown.indexOf(this.map.selected);
    const next = at < 0 ? (direction > 0 ? 0 : shown.length - 1) : (at + direction + shown.length) % shown.length;
    this.select(shown[next], true);
  }

  drawScale() {
    const target = 110 / this.map.view.scale, power = 10 ** Math.floor(Math.log10(target));
    const length = [5, 2, 1].map(step => step * power).find(step => step <= target) || power;
    byId("scale-bar").style.width = `${length * this.map.view.scale}px`;
    byId("scale-text").textContent = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${Math.round(length * 100)} cm`;
  }

  // --- pointer, keyboard, buttons ----------------------------------------------------------------------------------

  connectPointer() {
    const canvas = this.map.canvas, map = this.map;
    const place = event => {
      const box = canvas.getBoundingClientRect();
      return { x: event.clientX - box.left, y: event.clientY - box.top };
    };
    canvas.addEventListener("pointerdown", event => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, { ...place(event), moved: 0 });
    });
    canvas.addEventListener("pointermove", event => {
      const now = place(event), held = this.pointers.get(event.pointerId);
      if (!held) {
        this.hover(now);
        return;
      }
      this.drag(event.pointerId, held, now);
    });
    const release = event => {
      const held = this.pointers.get(event.pointerId);
      this.pointers.delete(event.pointerId);
      canvas.classList.remove("dragging");
      if (event.type === "pointerup" && held && held.moved < 5) this.click(place(event), event.pointerType === "touch" ? 18 : 9);
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      const { x, y } = place(event);
      const lines = event.deltaMode === 1 ? 16 : 1;
      map.zoom(Math.exp(-event.deltaY * lines * 0.0016), x, y);
    }, { passive: false });
    canvas.addEventListener("dblclick", event => {
      const { x, y } = place(event);
      map.zoom(2, x, y);
    });
  }

  // One pointer pans; two pan and zoom by their distance.
  drag(id, held, now) {
    const map = this.map, others = [...this.pointers].filter(([other]) => other !== id).map(([, each]) => each);
    held.moved += Math.hypot(now.x - held.x, now.y - held.y);
    if (others.length === 1) {
      const other = others[0];
      other.moved = held.moved = 99;
      const before = Math.hypot(held.x - other.x, held.y - other.y), after = Math.hypot(now.x - other.x, now.y - other.y);
      map.pan((now.x - held.x) / 2, (now.y - held.y) / 2);
      if (before > 1) map.zoom(after / before, (now.x + other.x) / 2, (now.y + other.y) / 2);
    } else if (others.length === 0 && held.moved >= 5) {
      map.canvas.classList.add("dragging");
      map.pan(now.x - held.x, now.y - held.y);
    }
    held.x = now.x;
    held.y = now.y;
  }

  hover({ x, y }) {
    const at = this.map.toMap(x, y), edge = this.map.edgeAt(x, y);
    byId("cursor").textContent = `${at.x.toFixed(2)}, ${at.y.toFixed(2)} m`;
    this.map.canvas.classList.toggle("over", Boolean(edge));
    if (edge !== this.hovered && !this.map.selected) this.say(edge);
    this.hovered = edge;
  }

  click({ x, y }, reach) {
    if (this.onPick && this.onPick(this.map.nodeAt(x, y, reach + 8))) return;
    this.select(this.map.edgeAt(x, y, reach));
  }

  connectKeyboard() {
    const map = this.map;
    const actions = {
      ArrowLeft: () => map.pan(PAN_PX, 0), ArrowRight: () => map.pan(-PAN_PX, 0),
      ArrowUp: () => map.pan(0, PAN_PX), ArrowDown: () => map.pan(0, -PAN_PX),
      "+": () => map.zoom(ZOOM_STEP), "=": () => map.zoom(ZOOM_STEP),
      "-": () => map.zoom(1 / ZOOM_STEP), _: () => map.zoom(1 / ZOOM_STEP),
      0: () => map.showAll(), Home: () => map.showAll(),
      n: () => this.step(1), p: () => this.step(-1), N: () => this.step(1), P: () => this.step(-1),
      Escape: () => this.select(null),
    };
    map.canvas.addEventListener("keydown", event => {
      if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in actions)) return;
      event.preventDefault();
      actions[event.key]();
    });
  }

  connectButtons() {
    byId("zoom-in").addEventListener("click", () => this.map.zoom(ZOOM_STEP));
    byId("zoom-out").addEventListener("click", () => this.map.zoom(1 / ZOOM_STEP));
    byId("zoom-home").addEventListener("click", () => this.map.showAll());
    for (const input of document.querySelectorAll('input[name="colour"]')) {
      input.addEventListener("change", () => {
        this.map.colourBy = input.value;
        this.buildLegend();
        this.map.redraw();
      });
    }
  }
}

window.report = new Report();
