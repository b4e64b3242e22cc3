"use strict";
(() => {
  const { clock, plots } = JSON.parse(document.getElementById("plots").textContent);
  const video = document.getElementById("video");
  const slider = document.getElementById("seek");
  const output = document.getElementById("now");
  const touch = matchMedia("(pointer: coarse)").matches;
  const timed = [];
  let frame = 0;

  // Between two knots the time is interpolated; `from` and `to` are frames and seconds, either way.
  function interpolated(from, to, value) {
    let low = 0, high = from.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (from[middle] <= value) low = middle; else high = middle;
    }
    const step = from[high] - from[low];
    const share = step > 0 ? Math.min(Math.max((value - from[low]) / step, 0), 1) : 0;
    return to[low] + share * (to[high] - to[low]);
  }
  const secondsOf = (t) => interpolated(clock.knots, clock.stamp_s, t);
  const frameOf = (seconds) => Math.floor(interpolated(clock.stamp_s, clock.knots, seconds) + 1e-3);

  function placeCursor({ element, cursor }) {
    const { xaxis, yaxis } = element._fullLayout;
    const x = xaxis.l2p(secondsOf(frame));
    cursor.hidden = x < -1 || x > xaxis._length + 1;
    cursor.style.left = `${xaxis._offset + x - 1}px`;
    cursor.style.top = `${yaxis._offset}px`;
    cursor.style.height = `${yaxis._length}px`;
  }

  function show(t) {
    frame = Math.min(Math.max(t, 0), clock.frames - 1);
    slider.value = frame;
    output.textContent = `frame ${frame}, ${secondsOf(frame).toFixed(2)} s`;
    slider.setAttribute("aria-valuetext", output.textContent);
    timed.forEach(placeCursor);
  }

  function go(t) {
    show(t);
    if (video) video.currentTime = (frame + 0.5) / clock.frames_per_s;
  }

  function follow() {
    const t = Math.floor(video.currentTime * clock.frames_per_s + 1e-3);
    if (t !== frame) show(t);
  }

  function seekOnClick(element) {
    let pressed = null;
    element.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
    window.addEventListener("pointerup", (event) => {
      const [x, y] = pressed ?? [Infinity, Infinity];
      pressed = null;
      if (Math.hypot(event.clientX - x, event.clientY - y) > 4) return; // a drag enlarges
      const { xaxis } = element._fullLayout;
      const place = event.clientX - element.getBoundingClientRect().left - xaxis._offset;
      if (place >= 0 && place <= xaxis._length) go(frameOf(xaxis.p2l(place)));
    }, true);
  }

  function draw({ id, data, layout, timed: hasTime }) {
    const element = document.getElementById(id);
    const config = { responsive: true, displayModeBar: hasTime ? false : "hover", modeBarButtons: [["resetCameraDefault3d"]], displaylogo: false, showTips: false };
    if (hasTime) layout.dragmode = touch ? false : "zoom"; // on a phone a finger scrolls the page
    return Plotly.newPlot(element, data, layout, config).then(() => {
      if (!hasTime) return;
      const cursor = document.createElement("div");
      cursor.className = "cursor";
      element.append(cursor);
      timed.push({ element, cursor });
      element.on("plotly_afterplot", () => placeCursor({ element, cursor }));
      placeCursor({ element, cursor });
      seekOnClick(element);
    });
  }

  const button = document.getElementById("theme");
  const wanted = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (document.documentElement.dataset.theme ?? (wanted.matches ? "dark" : "light")) === "dark";
  const tell = () => button.setAttribute("aria-pressed", String(isDark()));
  button.addEventListener("click", () => {
    document.documentElement.dataset.theme = isDark() ? "light" : "dark";
    tell();
  });
  wanted.addEventListener("change", tell);
  tell();

  slider.addEventListener("input", () => go(Number(slider.value)));
  document.querySelectorAll("[data-frame]").forEach((each) => {
    each.addEventListener("click", () => go(Number(each.dataset.frame)));
  });
  if (video) {
    const tick = () => { follow(); if (!video.paused && !video.ended) requestAnimationFrame(tick); };
    video.addEventListener("play", tick);
    video.addEventListener("seeked", follow);
  }
  const resize = (width) => plots.forEach(({ id }) => Plotly.relayout(id, { width, autosize: !width }));
  addEventListener("beforeprint", () => resize(660)); // as wide as paper
  addEventListener("afterprint", () => resize(null));
  plots.reduce((done, plot) => done.then(() => draw(plot)), Promise.resolve());
})();
