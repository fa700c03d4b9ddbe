"use strict";
// Draws the layers on a canvas and moves the view: no controls, no words. Lengths are metres unless a name says px.
class RunMap {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.view = { x: 0, y: 0, scale: 1 };
    this.home = [-1, 1, -1, 1];
    this.images = {};
    this.paths = [];
    this.nodes = { x: [], y: [] };
    this.edges = [];
    this.visible = {};
    this.colourBy = "kind";
    this.selected = null;
    this.marked = [];
    this.onView = () => {};
    this.colours = {};
    this.pending = false;
    this.resized = false;
    new ResizeObserver(() => this.resize()).observe(canvas);
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", () => this.restyle());
  }

  // Turns x0 y0 dx1 dy1 ... in millimetres into coordinates in metres.
  static positions(steps) {
    const count = steps.length / 2, x = new Float64Array(count), y = new Float64Array(count);
    let a = 0, b = 0;
    for (let k = 0; k < count; k++) {
      a += steps[2 * k];
      b += steps[2 * k + 1];
      x[k] = a / 1000;
      y[k] = b / 1000;
    }
    return { x, y };
  }

  colour(name) {
    if (!(name in this.colours)) {
      this.colours[name] = getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim() || "#888";
    }
    return this.colours[name];
  }

  static channels(colour) {
    const value = parseInt(colour.slice(1), 16);
    return [value >> 16, (value >> 8) & 255, value & 255];
  }

  restyle() {
    this.colours = {};
    for (const image of Object.values(this.images)) image.paint();
    this.redraw();
  }

  // Occupancy comes as one grey channel and gets the page's colours; other pictures stay as they are.
  setImage(name, layer, grey) {
    const [left, right, bottom, top] = layer.extent;
    const picture = new Image();
    const image = { left, right, bottom, top, drawn: null, paint: () => {} };
    image.paint = () => {
      if (!picture.naturalWidth) return;
      image.drawn = grey ? this.tinted(picture) : picture;
    };
    picture.onload = () => {
      if (this.images[name] !== image) return;
      image.paint();
      this.redraw();
    };
    picture.src = layer.png;
    this.images[name] = image;
  }

  tinted(picture) {
    const canvas = document.createElement("canvas");
    canvas.width = picture.naturalWidth;
    canvas.height = picture.naturalHeight;
    const context = canvas.getContext("2d");
    context.drawImage(picture, 0, 0);
    const image = context.getImageData(0, 0, canvas.width, canvas.height), data = image.data;
    const free = RunMap.channels(this.colour("free")), wall = RunMap.channels(this.colour("wall"));
    const unseen = RunMap.channels(this.colour("unseen"));
    const palette = [];
    for (let grey = 0; grey < 256; grey++) {
      palette.push(grey === 128 ? unseen : free.map((from, k) => Math.round(from + (wall[k] - from) * grey / 255)));
    }
    for (let k = 0; k < data.length; k += 4) {
      const colour = palette[data[k]];
      data[k] = colour[0];
      data[k + 1] = colour[1];
      data[k + 2] = colour[2];
    }
    context.putImageData(image, 0, 0);
    return canvas;
  }

  resize() {
    const box = this.canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    if (!box.width || !box.height) return;
    this.ratio = ratio;
    this.width = box.width;
    this.height = box.height;
    this.canvas.width = Math.round(box.width * ratio);
    this.canvas.height = Math.round(box.height * ratio);
    if (!this.resized) this.showAll();
    this.resized = true;
    this.draw();
  }

  showAll() {
    const [left, right, bottom, top] = this.home;
    this.view.x = (left + right) / 2;
    this.view.y = (bottom + top) / 2;
    const across = Math.max(right - left, 0.1), up = Math.max(top - bottom, 0.1);
    this.view.scale = 0.94 * Math.min(this.width / across, this.height / up);
    this.least = this.view.scale / 20;
    this.redraw();
  }

  pan(dxPx, dyPx) {
    this.view.x -= dxPx / this.view.scale;
    this.view.y += dyPx / this.view.scale;
    this.redraw();
  }

  // Zooms by a factor about a point of the canvas, its middle by default.
  zoom(factor, xPx = this.width / 2, yPx = this.height / 2) {
    const before = this.toMap(xPx, yPx);
    this.view.scale = Math.min(Math.max(this.view.scale * factor, this.least || 1e-3), 5000);
    const after = this.toMap(xPx, yPx);
    this.view.x += before.x - after.x;
    this.view.y += before.y - after.y;
    this.redraw();
  }

  centreOn(x, y) {
    this.view.x = x;
    this.view.y = y;
    this.redraw();
  }

  toMap(xPx, yPx) {
    return { x: this.view.x + (xPx - this.width / 2) / this.view.scale, y: this.view.y - (yPx - this.height / 2) / this.view.scale };
  }

  px(x) { return (x - this.view.x) * this.view.scale + this.width / 2; }
  py(y) { return (this.view.y - y) * this.view.scale + this.height / 2; }

  redraw() {
    if (this.pending || !this.resized) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.draw();
    });
  }

  draw() {
    const c = this.context;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.fillStyle = this.colour("unseen");
    c.fillRect(0, 0, this.width, this.height);
    c.lineJoin = c.lineCap = "round";
    for (const name of ["occupancy", "texture"]) {
      const image = this.images[name];
      if (!image || !image.drawn || !this.visible[name]) continue;
      const pixel = (image.right - image.left) / image.drawn.width * this.view.scale;
      c.imageSmoothingEnabled = pixel < 1;
      c.imageSmoothingQuality = "high";
      c.drawImage(image.drawn, this.px(image.left), this.py(image.top), (image.right - image.left) * this.view.scale, (image.top - image.bottom) * this.view.scale);
    }
    this.drawEdges(edge => !edge.accepted && edge.layer === "rejected", 0.8, 0.5);
    this.drawEdges(edge => edge.layer === "overlaps", 0.8, 0.55);
    this.drawEdges(edge => edge.layer === "loops" && edge.kind === "fixed_interval", 4, 0.75);
    for (const path of this.paths) if (this.visible[path.layer]) this.drawPath(path);
    this.drawEdges(edge => edge.layer === "loops" && edge.kind !== "fixed_interval", 1.6, 1, true);
    this.drawMarks();
    this.onView();
  }

  drawPath(path) {
    const c = this.context, { x, y } = path;
    if (!x.length) return;
    c.beginPath();
    c.moveTo(this.px(x[0]), this.py(y[0]));
    for (let k = 1; k < x.length; k++) c.lineTo(this.px(x[k]), this.py(y[k]));
    c.setLineDash([]);
    c.strokeStyle = this.colour("halo");
    c.globalAlpha = 0.7;
    c.lineWidth = path.width + 2;
    c.stroke();
    c.globalAlpha = 1;
    c.setLineDash(path.dash);
    c.strokeStyle = this.colour(path.colour);
    c.lineWidth = path.width;
    c.stroke();
    c.setLineDash([]);
    this.drawEnd(x[0], y[0], path.colour, false);
    this.drawEnd(x[x.length - 1], y[y.length - 1], path.colour, true);
  }

  drawEnd(x, y, colour, square) {
    const c = this.context, a = this.px(x), b = this.py(y), size = square ? 4 : 6;
    c.beginPath();
    if (square) c.rect(a - size, b - size, 2 * size, 2 * size);
    else c.arc(a, b, size, 0, 2 * Math.PI);
    c.fillStyle = this.colour("halo");
    c.fill();
    c.lineWidth = 2;
    c.strokeStyle = this.colour(colour);
    c.stroke();
  }

  // 0, 1, 2 and from 3 sigma on have a colour of their own; between them the colours are blended.
  edgeColour(edge) {
    if (edge.layer === "rejected") return this.colour("rejected");
    if (this.colourBy === "kind" || edge.sigma === null) return this.colour(edge.kind);
    const value = Math.min(Math.max(edge.sigma, 0), 2.999), low = Math.floor(value);
    const key = `blend-${Math.round(value * 10)}`;
    if (!(key in this.colours)) {
      const a = RunMap.channels(this.colour(`sigma-${low}`)), b = RunMap.channels(this.colour(`sigma-${low + 1}`));
      this.colours[key] = `rgb(${a.map((from, k) => Math.round(from + (b[k] - from) * (value - low))).join(",")})`;
    }
    return this.colours[key];
  }

  shown(edge) {
    return this.visible[edge.layer] && (!edge.group || this.visible[edge.group] !== false);
  }

  // Edges of one colour are one path: twenty thousand of them are drawn in some milliseconds.
  drawEdges(chosen, width, alpha, dots = false) {
    const c = this.context, byColour = new Map();
    let drawn = 0;
    for (const edge of this.edges) {
      if (!chosen(edge) || !this.shown(edge)) continue;
      drawn += 1;
      const colour = edge.off ? "off" : this.edgeColour(edge);
      if (!byColour.has(colour)) byColour.set(colour, []);
      byColour.get(colour).push(edge);
    }
    const crowding = Math.sqrt(200 / Math.max(drawn, 200));
    const lineWidth = dots ? Math.max(width * crowding, 0.9) : width;
    // the worst are drawn last, over the others
    const groups = [...byColour].sort(([, a], [, b]) => (a[0].sigma ?? 0) - (b[0].sigma ?? 0));
    for (const [colour, edges] of this.colourBy === "chi2" ? groups : byColour) {
      c.beginPath();
      for (const edge of edges) {
        c.moveTo(this.px(this.nodes.x[edge.i]), this.py(this.nodes.y[edge.i]));
        c.lineTo(this.px(this.nodes.x[edge.j]), this.py(this.nodes.y[edge.j]));
      }
      c.globalAlpha = colour === "off" ? 0.6 : alpha;
      c.strokeStyle = colour === "off" ? this.colour("rejected") : colour;
      c.setLineDash(colour === "off" ? [4, 4] : []);
      c.lineWidth = lineWidth;
      c.stroke();
      c.setLineDash([]);
      if (dots) this.drawDots(edges, Math.min(Math.max(0.12 * this.view.scale, 1), 2.4 * crowding + 0.6), colour === "off" ? this.colour("rejected") : colour);
      c.globalAlpha = 1;
    }
  }

  drawDots(edges, radius, colour) {
    const c = this.context;
    c.beginPath();
    for (const edge of edges) {
      for (const node of [edge.i, edge.j]) {
        const x = this.px(this.nodes.x[node]), y = this.py(this.nodes.y[node]);
        c.moveTo(x + radius, y);
        c.arc(x, y, radius, 0, 2 * Math.PI);
      }
    }
    c.fillStyle = colour;
    c.fill();
  }

  drawMarks() {
    const c = this.context;
    const edge = this.selected;
    if (edge) {
      c.beginPath();
      c.moveTo(this.px(this.nodes.x[edge.i]), this.py(this.nodes.y[edge.i]));
      c.lineTo(this.px(this.nodes.x[edge.j]), this.py(this.nodes.y[edge.j]));
      for (const [colour, width] of [["halo", 7], ["selected", 3.5]]) {
        c.strokeStyle = this.colour(colour);
        c.lineWidth = width;
        c.stroke();
      }
    }
    for (const node of edge ? [edge.i, edge.j, ...this.marked] : this.marked) {
      c.beginPath();
      c.arc(this.px(this.nodes.x[node]), this.py(this.nodes.y[node]), 6, 0, 2 * Math.PI);
      c.fillStyle = this.colour("selected");
      c.fill();
      c.lineWidth = 2;
      c.strokeStyle = this.colour("halo");
      c.stroke();
    }
  }

  // The visible edge nearest to a point of the canvas within reach, or null.
  edgeAt(xPx, yPx, reachPx = 9) {
    let best = null, least = reachPx;
    for (const edge of this.edges) {
      if (!this.shown(edge)) continue;
      const ax = this.px(this.nodes.x[edge.i]), ay = this.py(this.nodes.y[edge.i]);
      const dx = this.px(this.nodes.x[edge.j]) - ax, dy = this.py(this.nodes.y[edge.j]) - ay;
      const along = Math.min(Math.max(((xPx - ax) * dx + (yPx - ay) * dy) / Math.max(dx * dx + dy * dy, 1e-9), 0), 1);
      const distance = Math.hypot(ax + along * dx - xPx, ay + along * dy - yPx) + (edge.layer === "overlaps" ? 2 : 0);
      if (distance < least) {
        least = distance;
        best = edge;
      }
    }
    return best;
  }

  // The keyframe nearest to a point of the canvas within reach, or -1.
  nodeAt(xPx, yPx, reachPx = 14) {
    let best = -1, least = reachPx;
    for (let k = 0; k < this.nodes.x.length; k++) {
      const distance = Math.hypot(this.px(this.nodes.x[k]) - xPx, this.py(this.nodes.y[k]) - yPx);
      if (distance < least) {
        least = distance;
        best = k;
      }
    }
    return best;
  }
}
