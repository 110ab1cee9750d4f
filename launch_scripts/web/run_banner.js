// Says on the live page what the viewer does not: that it is behind, that the run is over, that the view was begun
// anew. Before the viewer has anything to show it covers the page by another: the run, its terrain and figures, and how
// far the 3D view is. Asks /run.json once a second.
(() => {
  const BEHIND_S = 4;
  const LOOKS = 3; // in a row, so that a moment's delay is not told
  const banner = document.createElement("div");
  banner.id = "run-banner";
  banner.style.cssText =
    "position:fixed;left:50%;top:40px;transform:translateX(-50%);z-index:10;display:none;max-width:90vw;" +
    "padding:8px 14px;border-radius:6px;background:#e0a030;color:#111;font:14px/1.4 sans-serif;text-align:center";
  document.body.appendChild(banner);
  const start = document.createElement("div");
  start.id = "run-start";
  start.style.cssText =
    "position:fixed;inset:0;z-index:9;overflow:auto;padding:88px 32px 32px;background:#0d1011;color:#e8eaed;" +
    "font:16px/1.5 sans-serif;white-space:pre-line";
  const parts = {};
  for (const name of ["h1", "p", "img", "pre"]) start.appendChild((parts[name] = document.createElement(name)));
  parts.img.style.cssText = "display:block;max-width:min(900px,100%);max-height:60vh;border-radius:6px";
  parts.pre.style.cssText = "font:14px/1.5 sans-serif;white-space:pre-wrap";
  document.body.appendChild(start);
  let run = null, failures = 0, late = 0;

  // The fields of a protobuf message: [[number, value], ...]; a value is a BigInt or the bytes of what is inside.
  function fields(bytes) {
    const found = [];
    let at = 0;
    const varint = () => {
      let value = 0n;
      for (let shift = 0n; ; shift += 7n) {
        const byte = bytes[at++];
        if (byte === undefined) throw new Error("cut short");
        value |= BigInt(byte & 127) << shift;
        if (byte < 128) return BigInt.asIntN(64, value);
      }
    };
    while (at < bytes.length) {
      const key = Number(varint());
      const kind = key & 7;
      if (kind === 0) found.push([key >> 3, varint()]);
      else if (kind === 2) {
        const length = Number(varint());
        found.push([key >> 3, bytes.subarray(at, at + length)]);
        at += length;
      } else at += kind === 1 ? 8 : 4;
    }
    return found;
  }

  const inside = (bytes, number) => fields(bytes).filter(([n]) => n === number).map(([, value]) => value);

  // Seconds of the run that the viewer has taken in: the newest time of its recording. Null while it has none, NaN if
  // it does not tell, as another version of the viewer may not.
  function taken_s() {
    if (!window._handle) return null;
    try {
      const recordings = inside(window._handle.viewer_state(), 3);
      for (const recording of recordings)
        for (const timeline of inside(recording, 2)) {
          const [id] = inside(timeline, 1), [range] = inside(timeline, 3);
          if (new TextDecoder().decode(inside(id, 1)[0]) !== "sim_time" || !range) continue;
          const [newest] = inside(range, 2);
          if (newest !== undefined) return Number(newest) / 1e9;
        }
      return recordings.length ? NaN : null;
    } catch (error) {
      return NaN;
    }
  }

  // How far the 3D view is. The viewer's own page says in an element how much of its program has come.
  function waits_for(run, viewer) {
    const own = viewer && document.getElementById("center_text");
    if (own && own.querySelector("a")) return ""; // it cannot go on, and says why
    if (window._handle) return "3D view: waiting for its first picture";
    if (viewer) return `3D view: its program is loading ${document.getElementById("status")?.textContent.trim() ?? ""}`;
    return run.view ? "3D view: opening" : "3D view: not begun yet";
  }

  function cover(run) {
    const viewer = document.querySelector("canvas") !== null, text = waits_for(run, viewer);
    start.style.display = text && taken_s() === null ? "block" : "none";
    parts.h1.textContent = run.name ?? "";
    parts.p.textContent = [run.over ? "The run is over." : run.state, text].filter(Boolean).join("\n");
    parts.pre.textContent = (run.figures ?? []).join("\n");
    if (run.picture && !parts.img.src) parts.img.src = "/terrain.webp";
    if (!viewer && run.view)
      location.replace(`/?url=rerun%2Bhttp%3A%2F%2F${encodeURIComponent(location.host)}%2Fproxy&theme=dark&hide_welcome_screen=1`);
  }

  function say(text) {
    if (banner.textContent !== text) banner.textContent = text;
    banner.style.display = text ? "block" : "none";
  }

  function tell(how) {
    const taken = taken_s();
    const behind = run.at_s - (taken ?? 0) > BEHIND_S;
    late = behind ? late + 1 : 0;
    const seconds = (value) => `${value.toFixed(0)} s`;
    if (how) {
      const shown = behind && taken !== null ? ` This page has come to ${seconds(taken)} only.` : "";
      const whole = run.recording ? ` To see the whole run: ${run.recording}` : "";
      say(`${how} ${seconds(run.at_s)}.${shown}${whole}`);
    } else if (late >= LOOKS && taken === null) say(`This page is loading; the run is at ${seconds(run.at_s)}.`);
    else if (late >= LOOKS)
      say(
        `This page is behind: it has come to ${seconds(taken)}, and the run is at ${seconds(run.at_s)}. ` +
          "The browser draws too slowly for it (does it draw without a graphics card?)",
      );
    else say("");
  }

  async function look() {
    try {
      const reply = await fetch("/run.json", { cache: "no-store", signal: AbortSignal.timeout(4000) });
      const now = await reply.json();
      failures = 0;
      if (run?.life && now.life !== run.life) return say("The view was started anew: reload this page.");
      run = now;
      cover(run);
      tell(run.over ? "The run is over, at" : "");
    } catch (error) {
      failures += 1;
      if (failures > 1 && run !== null) tell("The run is over, or cannot be reached; last heard of at");
    }
  }

  setInterval(look, 1000);
  look();
})();
