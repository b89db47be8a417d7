// scoreboard-page.mjs - the scoreboard as one file for light, dark, phone and print, without scripts or anything to load.
// SPDX-License-Identifier: Apache-2.0
import { createHash } from "node:crypto";

const kStyle = `
:root{color-scheme:light dark;--paper:#f6f6f3;--card:#fff;--ink:#1b1f24;--soft:#5b6470;--line:#dfe1dd;--accent:#2b6cb0;--good:#1d7a46;
--fair:#8a6100;--bad:#b3261e;--tint:#eef2f6;--bar:#9dbbd8}
@media (prefers-color-scheme:dark){:root{--paper:#14171a;--card:#1c2024;--ink:#e8eaec;--soft:#9aa4af;--line:#30363c;--accent:#7db4ec;
--good:#64c98f;--fair:#e0b14a;--bad:#ff8a80;--tint:#23292f;--bar:#41658a}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",
"DejaVu Sans",sans-serif;font-variant-numeric:tabular-nums}
main{max-width:1400px;margin:0 auto;padding:28px 24px 64px}
h1{font-size:clamp(1.5rem,3.4vw,2.3rem);line-height:1.18;letter-spacing:-.015em;margin:.15em 0 .3em;text-wrap:balance}
h2{font-size:1.3rem;margin:52px 0 6px;letter-spacing:-.01em}
p{margin:.3em 0 1em;max-width:78ch}
a{color:var(--accent)}
code{font:.92em ui-monospace,"SF Mono",Menlo,Consolas,"DejaVu Sans Mono",monospace;overflow-wrap:anywhere}
.soft{color:var(--soft)}
.lead{font-size:1.08rem}
.good{color:var(--good)}.fair{color:var(--fair)}.bad{color:var(--bad)}
.wrap{margin:14px 0;background:var(--card);border:1px solid var(--line);border-radius:12px}
table{border-collapse:collapse;width:100%;font-size:.92rem}
th,td{padding:10px 12px;text-align:left;vertical-align:top;border-top:1px solid var(--line);font-weight:400}
thead th{border-top:0;color:var(--soft);font-weight:600;font-size:.82rem;vertical-align:bottom}
.number{text-align:right;white-space:nowrap}
.name{font-weight:650}
.name small,.board thead small{display:block;font-weight:400;font-size:.82rem;color:var(--soft)}
ul{list-style:none;margin:0;padding:0}
.why li{display:grid;grid-template-columns:3.4em 64px 1fr;gap:10px;align-items:baseline}
.why b{text-align:right;font-weight:600}
.meter{display:block;width:64px;height:9px;border-radius:3px;overflow:hidden;background:var(--tint);border:1px solid var(--line)}
.meter rect{fill:var(--bar)}
.board{table-layout:fixed}
.board thead th{position:sticky;top:0;z-index:1;background:var(--card);box-shadow:0 1px 0 var(--line);padding:10px 8px}
.board thead th:first-child{border-radius:12px 0 0}
.board thead th:last-child{border-radius:0 12px 0 0}
.board thead b{display:block;color:var(--ink);font-size:.95rem}
.board col:first-child{width:26%}
.board td,.board tbody th{padding:12px 8px}
.board tbody th{padding-left:14px}
.scene{display:grid;grid-template-columns:minmax(0,130px) 1fr;gap:12px}
.scene h3{font-size:.95rem;line-height:1.3;margin:0 0 4px}
.scene p{margin:0;font-size:.8rem;line-height:1.42;color:var(--soft);overflow-wrap:anywhere}
.larger .scene{grid-template-columns:1fr}
.larger .plain{max-width:60ch}
img{display:block;width:100%;max-width:130px;height:auto;border-radius:5px;border:1px solid var(--line);background:#000}
.exact img{image-rendering:pixelated}
.larger img{max-width:320px}
.db{margin-top:6px;font-weight:650}
.cause{font-size:.78rem;line-height:1.36;overflow-wrap:break-word;hyphens:auto}
.client{display:none}
.refused{border:1px dashed var(--line);border-radius:5px;padding:8px;font-size:.78rem;line-height:1.36;overflow-wrap:anywhere}
@media (max-width:900px){main{padding:18px 14px 40px}h2{margin-top:38px}
.why thead,.board thead{display:none}.why,.why tbody,.why tr,.why td,.why th,.board,.board tbody{display:block}
.why tr{padding:10px 14px;border-top:1px solid var(--line)}.why tr:first-child,.board tr:first-child{border-top:0}
.why th,.why td{border:0;padding:2px 0;text-align:left}.why .number{display:inline-block;margin-right:1.2em}
.why .number::after{content:" " attr(data-of);color:var(--soft)}.why ul{margin-top:6px}
.why li{grid-template-columns:2.8em 1fr}.why .meter{display:none}
.board tr{display:grid;grid-template-columns:repeat(auto-fill,minmax(98px,1fr));gap:16px 12px;padding:14px;border-top:1px solid var(--line)}
.board tbody th{grid-column:1/-1;padding:0}.board th,.board td{display:block;border:0;padding:0;min-width:0}.client{display:block;font-weight:600;font-size:.88rem}
.board img{margin-top:4px}.scene{grid-template-columns:110px 1fr}}
@media print{:root{--paper:#fff;--card:#fff;--ink:#000;--soft:#444;--line:#bbb;--good:#1d7a46;--fair:#8a6100;--bad:#b3261e;--tint:#f2f2f2;
color-scheme:light}body{font-size:10pt}main{max-width:none;padding:0}tr{break-inside:avoid}.board thead th{position:static}}
`;

const kAllowed = `sha256-${createHash("sha256").update(kStyle).digest("base64")}`;

const html = (text) => String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
/** As typeset. */
const set = (text) => html(text.replaceAll("^2", "\u00b2").replace(/sqrt\((\d+)\)/g, "\u221a$1"));
/** May be broken where a word begins. */
const broken = (name) => html(name).replace(/([a-z])(?=[A-Z])/g, "$1<wbr>");
const decibels = (psnr) => (psnr === null ? "equal" : `${psnr.toFixed(1)} dB`);
/** Never 100% of what is not all. */
const percent = (share, digits = 0) => {
  const unit = 10 ** digits;
  const value = Math.round(100 * unit * share) / unit;
  return `${(share < 1 && value >= 100 ? 100 - 1 / unit : value).toFixed(digits)}%`;
};
const count = (n) => n.toLocaleString("en");

function grade({ psnr, largest_difference: levels }) {
  if (levels <= 1) return "good";
  return psnr >= 35 ? "fair" : "bad";
}

function cell({ name }, score, picture, scene) {
  const client = `<span class="client">${broken(name)}</span>`;
  if (score.error !== undefined) return `<td>${client}<div class="refused"><b class="bad">not drawn</b><br>${html(score.error.slice(0, 200))}</div></td>`;
  const img = picture ? `<img alt="${html(`${scene} by ${name}`)}" src="${picture}">` : "";
  const [cause] = score.causes.toSorted((a, b) => b.share - a.share);
  let why = cause ? `${set(cause.sentence)}, ${percent(cause.share)}` : "";
  if (score.largest_difference <= 1) why = score.psnr === null ? "" : "a level at most, as rounding does";
  else if (!cause || cause.share < 1 - score.named) why = `${percent(1 - score.named)} not named${cause ? `; ${why}` : ""}`;
  return `<td>${client}${img}<div class="db ${grade(score)}">${decibels(score.psnr)}</div><div class="cause">${why}</div></td>`;
}

const title = ({ name, kind }) => (kind === "conformance" ? name.replace(/^(\d+)-/, "$1 ").replaceAll("-", " ") : name[0].toUpperCase() + name.slice(1));

function row(scene, clients, pictures) {
  const { definition } = pictures[scene.name] ?? {};
  const img = definition ? `<img alt="${html(scene.name)} by the definition" src="${definition}">` : "";
  const { gaussians, views } = scene;
  const more = scene.kind === "conformance" ? "" : ` ${count(gaussians)} Gaussians, ${views} views.`;
  const about = `<div><h3>${html(title(scene))}</h3><p>${set(scene.rule)}${more}</p></div>`;
  const head = img ? `<div class="scene">${img}${about}</div>` : `<div class="plain scene">${about}</div>`;
  const cells = clients.map((client) => cell(client, client.scenes[scene.name], pictures[scene.name]?.[client.key], scene.name));
  return `<tr><th scope="row">${head}</th>${cells.join("")}</tr>`;
}

function board(kinds, { scenes, clients }, pictures, more) {
  const rows = scenes.filter(({ kind }) => kinds.includes(kind));
  if (rows.length === 0) return "";
  const heads = clients.map(({ name, version, conformance }) => {
    const { psnr, named, scenes: n } = conformance;
    const all = kinds.includes("conformance") && n > 0 ? `<small>${decibels(psnr)}</small><small>${percent(named, 1)} named</small>` : "";
    return `<th scope="col"><b>${broken(name)}</b><small>${html(version)}</small>${all}</th>`;
  });
  return `<div class="wrap ${more}"><table class="board"><colgroup><col></colgroup><thead><tr><th scope="col">the definition</th>${heads.join("")}</tr></thead>
<tbody>
${rows.map((scene) => row(scene, clients, pictures)).join("\n")}
</tbody></table></div>
`;
}

function why({ key, name, version, conformance: { scenes, as_defined: n, psnr, named, causes } }) {
  if (scenes === 0) return "";
  const list = causes.filter(({ share }) => share >= 0.01).slice(0, 6).map(({ sentence, known, share }) => {
    const meter = `<svg class="meter" viewBox="0 0 100 1" preserveAspectRatio="none" aria-hidden="true"><rect width="${(100 * share).toFixed(1)}" height="1"/></svg>`;
    return `<li><b>${percent(share)}</b>${meter}<span>${set(sentence)}${known ? "" : ` <span class="soft">(found by trying)</span>`}</span></li>`;
  });
  return `<tr id="${key}"><th scope="row" class="name">${html(name)}<small>${html(version)}</small></th><td class="number" data-of="as defined">${n} of ${scenes}</td>
<td class="number" data-of="">${decibels(psnr)}</td><td class="number" data-of="named">${percent(named, 1)}</td><td><ul>${list.join("")}</ul></td></tr>`;
}

/** HTML. `pictures`: data URIs by scene and client, "definition" among them. */
export function scoreboardPage(record, pictures) {
  const { scenes, clients, date, commit, device, browser } = record;
  const n = scenes.filter(({ kind }) => kind === "conformance").length;
  const larger = board(["generated"], record, pictures, "larger");
  const real = board(["real"], record, pictures, "larger");
  return `<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:; style-src '${kAllowed}'">
<title>Web clients of 3D Gaussian splats: what they draw, and why it differs</title>
<link rel="icon" href="data:,">
<style>${kStyle}</style>
</head>
<body>
<main>
<h1>What web clients of 3D Gaussian splats draw, and why it differs</h1>
<p class="lead">${clients.length} clients from npm draw the same ${n} conformance scenes, each by its own defaults, and are compared with
<a href="../format/RENDERING.md">the image's definition</a>, that of the original 3DGS program.</p>
<p><b>dB</b> is the PSNR of a client's pictures from the definition's, both in 8 bits: the higher, the closer;
<b class="good">green</b> is at most one level off, <b class="fair">yellow</b> from 35 dB on, <b class="bad">red</b> below.
<b>Named</b> is the share of the squared error that <code>rgs-judge</code> accounts for by drawing the scene with the client's rules instead.
<b>Causes</b> are those rules; the share of each is how much of the squared error it takes away, after those found before it.</p>
<h2>Why each differs</h2>
<div class="wrap"><table class="why"><thead><tr><th scope="col">client</th><th scope="col" class="number">as defined</th><th scope="col" class="number">all
scenes</th><th scope="col" class="number">named</th><th scope="col">because it, by share of its squared error</th></tr></thead>
<tbody>
${clients.map(why).join("\n")}
</tbody></table></div>
<p class="soft">Over all conformance scenes that the client draws; one that differs much counts much. A cause that alone adds to the error is taken off
the next ones, which make up for it. antimatter15's <i>splat</i> is missing, because it is not on npm.</p>
<h2>Conformance scenes</h2>
<p>Each is about one rule, and shows the view that differs most. Under a picture is the cause that explains most.</p>
${board(["conformance"], record, pictures, "exact")}${larger && `<h2>Generated scenes</h2>\n${larger}`}${real && `<h2>A trained scene</h2>\n${real}`}<h2>Run it again</h2>
<p><code>sh scripts/scoreboard.sh</code> draws everything and writes this page and <a href="scoreboard.json">scoreboard.json</a>. This run:
${html(date)}, commit <code>${html(commit)}</code>, WebGL 2 by ${html(device)}, ${html(browser ?? "")}.</p>
</main>
</body>
</html>
`;
}
