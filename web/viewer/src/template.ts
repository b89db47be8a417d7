// template.ts - what is in the viewer's shadow root.
// SPDX-License-Identifier: Apache-2.0
export const kTemplate = `
<a class="skip" href="#picture">To the picture</a>
<header>
  <h1 id="title">RoofGS viewer</h1>
  <button id="open" type="button">Open…</button>
  <button id="screenshot" type="button">Screenshot</button>
  <button id="link" type="button">Copy link</button>
  <button id="theme" type="button" aria-pressed="false">Dark</button>
  <button id="menu" type="button" aria-expanded="false" aria-controls="panel">Settings</button>
  <input id="file" type="file" multiple hidden accept=".rgs,.ply,.spz,.sog,.json" aria-label="Scene files">
</header>
<main>
  <div id="stage">
    <canvas id="picture" tabindex="0" role="img" aria-label="No scene yet" aria-describedby="keys"></canvas>
    <canvas id="reference-picture" hidden aria-hidden="true"></canvas>
    <canvas id="map" hidden role="img" aria-label="Difference of the two pictures"></canvas>
    <input id="split" type="range" min="0" max="1000" value="500" hidden aria-label="Divider between the two pictures">
    <output id="psnr" hidden></output>
    <output id="overlay" hidden></output>
    <p id="left" class="tag" hidden></p>
    <p id="right" class="tag" hidden></p>
    <div id="welcome">
      <p><strong>Drop a scene here</strong>, or open one: .rgs, .ply, .spz or .sog. A second one is compared with the first.
        Nothing leaves this computer.</p>
    </div>
    <div id="loading" hidden>
      <progress id="progress" max="1" aria-label="Loading"></progress>
      <p id="progress-text"></p>
    </div>
  </div>
  <aside id="panel" aria-label="Settings">
    <fieldset id="compare" hidden>
      <legend>Compare</legend>
      <div id="modes" role="radiogroup" aria-label="Comparison mode">
        <label><input type="radio" name="mode" value="single"> One</label>
        <label><input type="radio" name="mode" value="slider"> Slider</label>
        <label><input type="radio" name="mode" value="flicker"> Flicker</label>
        <label><input type="radio" name="mode" value="difference"> Difference</label>
      </div>
    </fieldset>
    <fieldset>
      <legend>Picture</legend>
      <label>Background <input id="background" type="color" value="#000000"></label>
      <label for="sh">SH degree: <output id="sh-value">3</output><input id="sh" type="range" min="0" max="3" value="3"></label>
      <label for="detail">Detail: <output id="detail-value">1</output> px<input id="detail" type="range" min="0" max="16" step="0.25" value="1"></label>
      <label for="budget">Budget: <output id="budget-value"></output> Gaussians<input id="budget" type="range" min="4" max="7.3" step="0.1" value="6"></label>
      <label id="reference-label" hidden><input id="reference" type="checkbox"> Reference picture, from the server</label>
    </fieldset>
    <fieldset>
      <legend>Overlays</legend>
      <label><input id="stats" type="checkbox"> Statistics</label>
      <label><input id="boxes" type="checkbox"> Bounds</label>
      <label>Pages <select id="tint"><option value="none">plain</option><option value="level">by level</option><option value="error">by error</option></select></label>
    </fieldset>
    <fieldset id="camera-set" hidden>
      <legend>Cameras</legend>
      <button id="play" type="button" aria-pressed="false">Play path</button>
      <div id="cameras"></div>
    </fieldset>
    <details>
      <summary>Keys</summary>
      <p id="keys">Drag or arrows: orbit. Right drag: look around. Shift and drag: pan. Wheel, + and -: zoom. Double click or tap: focus. W A S D Q E
        or a gamepad: fly. N and B: next and previous camera. P: play the path. F: flicker. X: difference. C: slider. T: reference
        picture. I: statistics. O: open.</p>
    </details>
  </aside>
</main>
<div id="errors" role="alert"></div>
<div id="status" role="status" aria-live="polite"></div>
`;
