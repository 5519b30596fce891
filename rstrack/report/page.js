"use strict";
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const config = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["toImage", "lasso2d", "select2d"] };
  const hasWebGL = (() => {
    const canvas = document.createElement("canvas");
    return Boolean(canvas.getContext("webgl") || canvas.getContext("experimental-webgl"));
  })();
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // Colours of the page's theme for everything that a figure does not colour itself.
  function themed(layout) {
    const ink = color("--ink"), line = color("--line");
    const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, tickcolor: line };
    const changed = {
      ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink, size: 12, family: getComputedStyle(document.body).fontFamily },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: color("--soft"), activecolor: ink },
      hoverlabel: { bgcolor: color("--panel"), bordercolor: line, font: { color: ink } },
    };
    for (const name of Object.keys(layout)) {
      if (/^[xy]axis\d*$/.test(name)) changed[name] = { ...axis, ...layout[name] };
    }
    if (layout.scene) {
      changed.scene = { ...layout.scene };
      const solid = { ...axis, showbackground: false, color: ink };
      for (const name of ["xaxis", "yaxis", "zaxis"]) changed.scene[name] = { ...solid, ...layout.scene[name] };
    }
    return changed;
  }

  // Plotly takes a half-transparent cell for one on white: on a dark page its numbers would be dark too.
  function inked(trace) {
    return trace.type === "heatmap" ? { ...trace, textfont: { color: color("--ink") } } : trace;
  }

  // The plot's z points up, so its x and y are the view from above.
  function fromAbove({ data, layout: { scene, legend } }) {
    const flat = ({ x, y, name, opacity, line }) => ({
      type: "scatter", mode: "lines", x, y, name, opacity,
      line: { width: line.width / 2, color: Array.isArray(line.color) ? color("--accent") : line.color },
    });
    const axis = ({ title, range }) => ({ title, range, zeroline: false });
    const yaxis = { ...axis(scene.yaxis), scaleanchor: "x" };
    return { data: data.map(flat), layout: { legend, xaxis: axis(scene.xaxis), yaxis, margin: { l: 62, r: 12, t: 30, b: 46 } } };
  }

  function draw(element) {
    const figure = figures[Number(element.dataset.figure)];
    const isFlattened = Boolean(figure.layout.scene) && !hasWebGL;
    const { data, layout } = isFlattened ? fromAbove(figure) : figure;
    const parent = element.parentElement;
    for (const note of parent.querySelectorAll(".no-webgl")) note.hidden = !isFlattened;
    for (const turn of parent.querySelectorAll(".turn")) turn.hidden = isFlattened;
    return Plotly.react(element, data.map(inked), themed(layout), config);
  }

  // A browser keeps a dozen WebGL views or so: those that are not shown give theirs back.
  function refresh(within) {
    for (const element of within.querySelectorAll(".plot")) {
      if (element.closest("[hidden]")) Plotly.purge(element);
      else draw(element);
    }
  }

  for (const chooser of document.querySelectorAll(".chooser")) {
    const options = chooser.querySelectorAll(":scope > .option");
    chooser.querySelector("select").addEventListener("change", (event) => {
      options.forEach((option, k) => { option.hidden = k !== Number(event.target.value); });
      refresh(chooser);
    });
  }

  for (const compare of document.querySelectorAll(".compare")) {
    const range = compare.querySelector("input"), stack = compare.querySelector(".stack");
    const show = (percent) => {
      range.value = percent;
      compare.style.setProperty("--split", `${range.value}%`);
    };
    range.addEventListener("input", () => show(range.value));
    compare.querySelector(".flip").addEventListener("click", () => show(Number(range.value) < 50 ? 100 : 0));
    const follow = (event) => {
      const box = stack.getBoundingClientRect();
      show((100 * (event.clientX - box.left)) / box.width);
    };
    stack.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      stack.setPointerCapture(event.pointerId);
      follow(event);
    });
    stack.addEventListener("pointermove", (event) => { if (event.buttons) follow(event); });
  }

  // Up first, then down; cells that hold no number stay below those that do.
  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    const words = (row, k) => row.cells[k].textContent.trim();
    heads.forEach((head, k) => head.querySelector("button").addEventListener("click", () => {
      const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      const isText = head.classList.contains("words") || k === 0;
      const order = (a, b) => {
        if (isText) return sign * words(a, k).localeCompare(words(b, k));
        const [x, y] = [a, b].map((row) => parseFloat(words(row, k)));
        return isNaN(x) || isNaN(y) ? isNaN(x) - isNaN(y) : sign * (x - y);
      };
      body.append(...[...body.rows].sort(order));
    }));
  }

  // Where a browser keeps the clipboard from a page that was opened as a file, the text is marked for Ctrl-C.
  for (const file of document.querySelectorAll(".file")) {
    const text = file.querySelector("pre"), said = file.querySelector(".said");
    file.querySelector(".copy").addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(text.textContent);
        said.textContent = "Copied.";
      } catch {
        getSelection().selectAllChildren(text);
        said.textContent = "Marked: press Ctrl-C.";
      }
    });
  }

  // The mouse turns the 3D view; so does this slider, for the keyboard. It turns by as much as it was moved.
  for (const turn of document.querySelectorAll("input[data-turns]")) {
    let before = Number(turn.value);
    turn.addEventListener("input", () => {
      const element = document.getElementById(turn.dataset.turns), { eye } = element.layout.scene.camera;
      const angle = ((Number(turn.value) - before) * Math.PI) / 180;
      before = Number(turn.value);
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      Plotly.relayout(element, { "scene.camera.eye": { x: c * eye.x - s * eye.y, y: s * eye.x + c * eye.y, z: eye.z } });
    });
  }

  refresh(document);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => refresh(document));
})();
