// template.ts - what is in the viewer's shadow root.
// SPDX-License-Identifier: Apache-2.0

/** Strokes in a square of 24. */
const kIcons = {
  open: "M3 6v12a1 1 0 0 0 1 1h16a1 1 0 0 0 1-1V9a1 1 0 0 0-1-1h-8L9.5 5H4a1 1 0 0 0-1 1z",
  home: "M4 11l8-7 8 7M6 10v10h12V10",
  views: "M4 4h7v7H4zM13 4h7v7h-7zM4 13h7v7H4zM13 13h7v7h-7z",
  screenshot: "M3 8h4l2-3h6l2 3h4v11H3zM12 16.5a3.5 3.5 0 1 0 0-7 3.5 3.5 0 0 0 0 7z",
  save: "M5 4h11l3 3v13H5zM8 4v5h7V4M8 20v-6h8v6",
  link: "M10 14a4 4 0 0 0 6 0l3-3a4.2 4.2 0 0 0-6-6l-1 1M14 10a4 4 0 0 0-6 0l-3 3a4.2 4.2 0 0 0 6 6l1-1",
  theme: "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zM12 3v18M12 8h7M12 12h9M12 16h7",
  menu: "M3 7h10M17 7h4M3 17h4M11 17h10M15 9a2 2 0 1 0 0-4 2 2 0 0 0 0 4zM9 19a2 2 0 1 0 0-4 2 2 0 0 0 0 4z",
  help: "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zM9.6 9.6a2.4 2.4 0 1 1 3.6 2.1c-.8.5-1.2 1-1.2 1.9M12 16.6v.01",
  full: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5",
  close: "M6 6l12 12M18 6L6 18",
  split: "M9 7l-5 5 5 5M15 7l5 5-5 5",
  drop: "M12 3v12M7 10l5 5 5-5M4 17v3h16v-3",
} as const;

const icon = (name: keyof typeof kIcons): string => `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${kIcons[name]}"/></svg>`;
const button = (name: keyof typeof kIcons, label: string, more = ""): string =>
  `<button id="${name}" type="button" aria-label="${label}" title="${label}" ${more}>${icon(name)}</button>`;
const opener = (name: keyof typeof kIcons, label: string): string => button(name, label, `aria-expanded="false" aria-controls="panel"`);
const key = (keys: string, what: string): string => `<dt>${keys.split(" ").map((each) => `<kbd>${each}</kbd>`).join(" ")}</dt><dd>${what}</dd>`;

export const kCloseIcon = icon("close");

export const kTemplate = `
<a class="skip" href="#picture">To the picture</a>
<header>
  <h1 id="title" class="pill">RoofGS viewer</h1>
  <div class="pill" role="group" aria-label="Viewer">
    ${button("open", "Open a scene (O)")}
    ${opener("views", "Cameras")}
    ${opener("save", "Save as .rgs")}
    ${button("home", "First view (H)")}
    ${button("screenshot", "Save a screenshot")}
    ${button("link", "Copy a link to this view")}
    ${button("theme", "Dark", `aria-pressed="false"`)}
    ${button("full", "Full screen")}
    ${opener("help", "Keys and gestures")}
    ${opener("menu", "Settings")}
  </div>
  <input id="file" type="file" multiple hidden accept=".rgs,.ply,.spz,.sog,.json" aria-label="Scene files">
</header>
<div id="stage">
  <canvas id="picture" tabindex="0" role="img" aria-label="No scene yet" aria-describedby="keys"></canvas>
  <canvas id="reference-picture" hidden aria-hidden="true"></canvas>
  <canvas id="map" hidden role="img" aria-label="Difference of the two pictures"></canvas>
  <div id="split" role="slider" tabindex="0" aria-label="Divider between the two pictures" aria-orientation="horizontal"
    aria-valuemin="0" aria-valuemax="1000" hidden>${icon("split")}</div>
  <output id="overlay" class="pill" hidden></output>
  <p id="left" class="tag pill" hidden></p>
  <p id="right" class="tag pill" hidden></p>
  <div id="foot">
    <div id="legend" class="pill" hidden>
      <output id="psnr" title="Peak signal-to-noise ratio: higher is more alike"></output>
      <output id="flip" title="FLIP, the difference that people see when they flip between the two: lower is more alike"></output>
      <span class="scale">0 <span id="ramp"></span> <span id="top"></span></span>
    </div>
    <div id="working" class="pill" hidden><span id="working-text"></span> <button id="cancel-map" type="button">Cancel</button></div>
    <fieldset id="compare" class="pill" hidden>
      <legend>Compare</legend>
      <div id="modes" role="radiogroup" aria-label="Comparison mode">
        <label><input type="radio" name="mode" value="single"> <span>One</span></label>
        <label><input type="radio" name="mode" value="slider"> <span>Slider</span></label>
        <label><input type="radio" name="mode" value="flicker"> <span>Flicker</span></label>
        <label><input type="radio" name="mode" value="difference"> <span>Difference</span></label>
      </div>
    </fieldset>
  </div>
  <div id="welcome">
    <div class="drop">
      ${icon("drop")}
      <p><strong>Drop a scene here</strong></p>
      <p>.rgs, .ply, .spz or .sog; a second one is compared with the first. Nothing leaves this computer.</p>
      <button id="open-first" type="button">Open a scene…</button>
      <button id="sample" type="button" hidden>Look at a sample</button>
    </div>
  </div>
  <div id="loading" hidden>
    <progress id="progress" max="1" aria-label="Loading"></progress>
    <p class="pill"><span id="progress-text"></span> <button id="cancel" type="button">Cancel</button></p>
  </div>
  <div id="stream" title="Details are being read" hidden></div>
  <div id="errors" role="alert"></div>
</div>
<aside id="panel" aria-label="Settings" hidden>
  <section class="views" id="camera-set">
    <h2>Cameras</h2>
    <button id="play" type="button" aria-pressed="false" title="Flies from camera to camera (P)">Play path</button>
    <div id="cameras"></div>
  </section>
  <section class="save">
    <h2>Save as .rgs</h2>
    <label class="row" title="Sizes are those of SH degree 3. packed and direct look as the PLY does, archives round more">Profile <select id="profile">
      <option value="packed">packed (1/5 of the PLY)</option><option value="direct">direct (1/3)</option>
      <option value="archive:high">archive:high (1/20)</option><option value="archive:small">archive:small (1/30)</option><option value="archive:tiny">archive:tiny (1/50)</option>
    </select></label>
    <label class="row" title="A large scene then opens at once, and a view reads only the pages that it needs"><input id="save-levels" type="checkbox"> Levels of detail</label>
    <div id="save-scenes"></div>
    <div id="saving" hidden><progress id="save-progress" max="1" aria-label="Converting"></progress><span id="saving-text"></span> <button id="cancel-save" type="button">Cancel</button></div>
    <output id="saved"></output>
  </section>
  <section class="menu">
    <h2>Picture</h2>
    <label class="row">Background <input id="background" type="color" value="#000000"></label>
    <label for="sh" title="How much colours change with the direction of view: 0 is not at all"><span>SH degree: <output id="sh-value">3</output></span><input id="sh" type="range" min="0" max="3" value="3"></label>
    <label class="row" id="reference-label" title="A picture of this view by the renderer that the formats are measured with (T)" hidden><input id="reference" type="checkbox"> Reference picture, from the server</label>
  </section>
  <section class="menu" id="levels">
    <h2>Levels of detail</h2>
    <label for="detail" title="The largest error allowed in the picture, in pixels: coarser pages are drawn where their error is smaller"><span>Detail: <output id="detail-value">1</output> px</span><input id="detail" type="range" min="0" max="16" step="0.25" value="1"></label>
    <label for="budget" title="The most Gaussians that are drawn at once"><span>Budget: <output id="budget-value"></output> Gaussians</span><input id="budget" type="range" min="4" max="7.3" step="0.1" value="6"></label>
    <label class="row">Colours <select id="tint"><option value="none">of the scene</option><option value="level">by level</option><option value="error">by error</option></select></label>
  </section>
  <section class="menu">
    <h2>Overlays</h2>
    <label class="row"><input id="stats" type="checkbox"> Statistics</label>
    <label class="row"><input id="boxes" type="checkbox"> Bounds</label>
  </section>
  <section class="help">
    <h2>Keys and gestures</h2>
    <dl id="keys">
      ${key("Drag", "orbit; one finger, too")}${key("Right-drag", "look around")}${key("Shift-drag", "pan; two fingers, too")}
      ${key("Wheel + -", "zoom; pinch, too")}${key("Double-click", "focus; double tap, too")}${key("← → ↑ ↓", "orbit")}
      ${key("W A S D Q E", "fly; a gamepad, too")}${key("N B", "next and previous camera")}${key("P", "play the path")}${key("H", "first view")}
      ${key("C F X", "slider, flicker, difference")}${key("T", "reference picture")}${key("I", "statistics")}${key("O", "open")}
    </dl>
  </section>
</aside>
<div id="status" role="status" aria-live="polite"></div>
`;
