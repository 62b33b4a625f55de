"use strict";
// Figure 1 as a chart: drag to enlarge, double-click to reset. The static figure is for printing.
(() => {
  const content = JSON.parse(document.getElementById("zoom-data").textContent);
  const figure = document.getElementById("figure-displacement");
  if (!figure || !window.uPlot) return;
  const GAP = -32768;
  const column = (text, scale) => {
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    const counts = new Int16Array(bytes.buffer);
    return Array.from(counts, n => (n === GAP ? null : n * scale));
  };
  const place = document.createElement("div");
  place.className = "zoom";
  const hint = document.createElement("p");
  hint.className = "hint";
  hint.textContent = "Drag across the chart to zoom in, double-click to zoom out. Click a name to hide its curve.";
  figure.append(place, hint);
  const charts = [];
  let following = false;
  const follow = (from, min, max) => {
    if (following) return;
    following = true;
    for (const chart of charts) if (chart !== from) chart.setScale("x", { min, max });
    following = false;
  };
  const width = () => Math.max(200, place.clientWidth);
  for (const panel of content.panels) {
    const ys = panel.series.map(s => column(s.data, panel.scale));
    const xs = ys[0].map((_, i) => content.start + i * content.step);
    const last = panel === content.panels[content.panels.length - 1];
    const title = document.createElement("p");
    title.className = "title";
    title.textContent = panel.label;
    place.append(title);
    const grid = { stroke: "#e7e7e3", width: 1 };
    charts.push(new uPlot({
      width: width(),
      height: panel.height,
      cursor: { sync: { key: "zoom" }, drag: { x: true, y: false } },
      legend: { show: last },
      scales: { x: { time: false } },
      series: [
        { label: "time, s", value: (_, v) => (v == null ? "–" : v.toFixed(3)) },
        ...panel.series.map(s => ({
          label: s.label, stroke: s.colour, width: s.width, points: { show: false },
          value: (_, v) => (v == null ? "–" : v.toFixed(3)),
        })),
      ],
      axes: [
        { show: last, stroke: "#1a1a1a", grid, ticks: grid, size: 32, font: "12px sans-serif" },
        { stroke: "#1a1a1a", grid, ticks: { show: false }, space: 24, size: 56, font: "12px sans-serif" },
      ],
      padding: [8, 16, 0, 0],
      hooks: {
        drawClear: [u => {
          if (!content.window) return;
          const [from, to] = content.window.map(t => u.valToPos(t, "x", true));
          const left = Math.max(from, u.bbox.left), right = Math.min(to, u.bbox.left + u.bbox.width);
          if (right <= left) return;
          u.ctx.fillStyle = "#fbf0d9";
          u.ctx.fillRect(left, u.bbox.top, right - left, u.bbox.height);
        }],
        setScale: [(u, key) => { if (key === "x") follow(u, u.scales.x.min, u.scales.x.max); }],
      },
    }, [xs, ...ys], place));
  }
  figure.classList.add("zoomed");
  addEventListener("resize", () => {
    for (const chart of charts) chart.setSize({ width: width(), height: chart.height });
  });
})();
