// audit_page.cpp - one style sheet for light, dark, phone and print, and the script of the sliders.
// SPDX-License-Identifier: Apache-2.0
#include "audit_page.hpp"

#include "audit_encoding.hpp"
#include "encoding.hpp"
#include "info_escape.hpp"

namespace rgs::audit {
namespace {

constexpr std::string_view kStyle = R"css(
:root{color-scheme:light dark;--paper:#f6f6f3;--card:#fff;--ink:#1b1f24;--soft:#5b6470;--line:#dfe1dd;--accent:#2b6cb0;
--bar:#9dbbd8;--good:#1d7a46;--fair:#8a6100;--bad:#b3261e;--tint:#eef2f6}
@media (prefers-color-scheme:dark){:root{--paper:#14171a;--card:#1c2024;--ink:#e8eaec;--soft:#9aa4af;--line:#30363c;
--accent:#7db4ec;--bar:#41658a;--good:#64c98f;--fair:#e0b14a;--bad:#ff8a80;--tint:#23292f}}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;scroll-behavior:smooth}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",
"DejaVu Sans",sans-serif;font-variant-numeric:tabular-nums}
main{max-width:1160px;margin:0 auto;padding:28px 24px 64px}
h1{font-size:clamp(1.5rem,3.4vw,2.3rem);line-height:1.18;letter-spacing:-.015em;margin:.15em 0 .3em;text-wrap:balance}
h2{font-size:1.3rem;margin:56px 0 6px;letter-spacing:-.01em}
h3{font-size:.95rem;margin:0 0 2px}
p{margin:.3em 0 1em;max-width:74ch}
.soft,figcaption,.note{color:var(--soft)}
.note,figcaption{font-size:.88rem}
a{color:var(--accent)}
.names{color:var(--soft);font-size:.95rem;overflow-wrap:anywhere}
.names b{color:var(--ink);font-weight:600}
.lead{font-size:1.08rem}
.badges{margin:0}
.badge{display:inline-block;border-radius:99px;padding:2px 12px;font-size:.8rem;font-weight:600;border:1.5px solid currentColor}
.good{color:var(--good)}.fair{color:var(--fair)}.bad{color:var(--bad)}
.three{display:grid;grid-template-columns:repeat(3,1fr);gap:16px;margin:22px 0}
.card,figure,.panel{background:var(--card);border:1px solid var(--line);border-radius:12px}
.card{padding:16px 20px}
.card dt{font-size:.85rem;color:var(--soft)}
.card dd{margin:0}
.card .big{font-size:clamp(1.7rem,4vw,2.6rem);font-weight:650;line-height:1.15;letter-spacing:-.02em}
.card .big small{font-size:.5em;font-weight:500;color:var(--soft);letter-spacing:0;margin-left:.15em}
nav{display:flex;flex-wrap:wrap;gap:4px 18px;font-size:.92rem;margin:18px 0 0}
figure{margin:0;padding:12px;min-width:0}
figure img{display:block;width:100%;height:auto;border-radius:6px}
figcaption{margin-top:8px}
.ab{position:relative;--cut:50%;overflow:hidden;border-radius:6px;line-height:0}
.ab img{border-radius:0}
.ab .over{position:absolute;inset:0;clip-path:inset(0 0 0 var(--cut))}
.ab .map{visibility:hidden}
.ab.mapped .map{visibility:visible}
.ab .photo{position:absolute;inset:0;visibility:hidden}
.ab.taken .photo{visibility:visible}
.ab input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize;touch-action:pan-y}
.ab input::-webkit-slider-thumb{width:2px}
.ab input::-moz-range-thumb{width:2px;border:0}
.ab .bar{position:absolute;top:0;bottom:0;left:var(--cut);width:2px;margin-left:-1px;background:#fff;box-shadow:0 0 0 1px #0006;
pointer-events:none}
.ab .bar::after{content:"\2194";position:absolute;top:50%;left:50%;width:38px;height:38px;margin:-19px;border-radius:50%;
background:#fff;color:#1b1f24;font:600 20px/38px system-ui,sans-serif;text-align:center;box-shadow:0 1px 6px #0007}
.ab input:focus-visible~.bar::after{outline:3px solid var(--accent);outline-offset:2px}
.ab .tag{position:absolute;top:10px;background:#000a;color:#fff;font:600 .8rem/1 system-ui,sans-serif;padding:6px 10px;
border-radius:6px;pointer-events:none}
.ab .tag.a{left:10px}.ab .tag.b{right:10px}
.switch+.switch{margin-left:24px}
.copy{font:.8rem system-ui,sans-serif;color:var(--accent);background:none;border:1px solid var(--line);border-radius:6px;
padding:1px 8px;margin-left:8px;cursor:pointer}
.switch{display:inline-flex;gap:8px;align-items:center;margin-top:8px;cursor:pointer}
.grid{display:grid;gap:16px;grid-template-columns:repeat(auto-fill,minmax(min(100%,320px),1fr));margin:14px 0}
.grid.wide{grid-template-columns:repeat(auto-fill,minmax(min(100%,480px),1fr))}
.grid.narrow{grid-template-columns:repeat(auto-fill,minmax(min(100%,240px),1fr))}
.triple,.quad{display:grid;grid-template-columns:repeat(3,1fr);gap:6px}
.quad{grid-template-columns:repeat(4,1fr)}
.triple img,.quad img{image-rendering:pixelated;border:1px solid var(--line)}
.strips{display:grid;gap:16px;margin:14px 0}
.triple span,.quad span{font-size:.78rem;color:var(--soft)}
.scale{display:flex;align-items:center;gap:10px;font-size:.88rem;color:var(--soft);margin:6px 0 14px;flex-wrap:wrap}
.scale svg{display:block;width:min(320px,50vw);height:12px;border-radius:3px;border:1px solid var(--line)}
.wrap{overflow-x:auto;margin:12px 0;background:var(--card);border:1px solid var(--line);border-radius:12px}
table{border-collapse:collapse;width:100%;font-size:.92rem}
th,td{padding:7px 12px;text-align:right;border-top:1px solid var(--line);white-space:nowrap}
thead th{border-top:0;white-space:normal;color:var(--soft);font-weight:600;font-size:.82rem;vertical-align:bottom}
th:first-child,td:first-child,.left{text-align:left}
td:first-child,tbody th{font-weight:500}
thead th:first-child{white-space:nowrap}
tbody tr:hover{background:var(--tint)}
tr.sum>*{border-top:2px solid var(--soft);font-weight:650}
tr.group>*{color:var(--soft);font-size:.82rem;font-weight:600;text-align:left;background:var(--tint)}
.meter{display:inline-block;vertical-align:middle;width:90px;height:9px;border-radius:3px;background:var(--tint);
border:1px solid var(--line);overflow:hidden;margin-right:12px}
.meter+b{display:inline-block;min-width:3.6em;font-weight:inherit}
.meter rect{fill:var(--accent)}
.panel{padding:14px 16px;min-width:0}
.panel th,.panel td{padding:5px 4px}
.panel p{margin:0 0 6px;font-size:.88rem}
.chart{display:block;width:100%;height:auto}
.chart .bars{fill:var(--bar)}
.chart .curve{fill:none;stroke:var(--bar);stroke-width:1.5;stroke-linecap:round}
.chart .second{stroke:var(--ink);stroke-width:4}
.chart .axis{stroke:var(--soft);stroke-width:1}
.chart .mark{stroke:var(--ink);stroke-width:1.5}
.chart .dashed{stroke-dasharray:5 3}.chart .dotted{stroke-dasharray:1.5 3}
.chart text{fill:var(--soft);font:11px system-ui,sans-serif}
.stack{display:block;width:100%;height:26px;border-radius:6px;overflow:hidden;border:1px solid var(--line);margin:12px 0 6px}
.key{display:inline-block;width:.8em;height:.8em;border-radius:3px;margin-right:7px;vertical-align:-.05em}
details{margin:12px 0}
summary{cursor:pointer;color:var(--accent);width:fit-content}
code{font:.92em ui-monospace,"SF Mono",Menlo,Consolas,"DejaVu Sans Mono",monospace;overflow-wrap:anywhere}
dl.facts{display:grid;grid-template-columns:max-content 1fr;gap:4px 20px;font-size:.92rem;margin:12px 0}
dl.facts dt{color:var(--soft)}dl.facts dd{margin:0;overflow-wrap:anywhere}
ul.gate{list-style:none;padding:0;margin:14px 0}
.warnings{margin:14px 0;padding-left:1.2em}
:focus-visible{outline:3px solid var(--accent);outline-offset:2px}
@media (max-width:640px){main{padding:18px 14px 40px}.three{grid-template-columns:1fr;gap:10px}.card{padding:12px 16px}
h2{margin-top:40px}th,td{padding:6px 9px}.meter{width:60px}dl.facts{grid-template-columns:1fr;gap:0}dl.facts dd{margin-bottom:8px}}
@media print{:root{--paper:#fff;--card:#fff;--ink:#000;--soft:#444;--line:#bbb;--accent:#1c4f85;--bar:#8fb0d0;--good:#1d7a46;
--fair:#8a6100;--bad:#b3261e;--tint:#f2f2f2;color-scheme:light}
body{font-size:10.5pt}main{max-width:none;padding:0}nav,.switch,.copy,.ab input,.ab .bar,.ab .map,.ab .photo,.screen{display:none!important}
h2{margin-top:20pt;break-after:avoid}figure,.panel,.card,tr{break-inside:avoid}
.ab{display:flex;gap:6px;overflow:visible}.ab img{width:50%}.ab .over{position:static;width:50%;clip-path:none}
.ab .tag.b{left:calc(50% + 13px);right:auto}.wrap{overflow:visible}table{font-size:8.5pt}
th,td{padding:3px 6px;white-space:normal}.three{grid-template-columns:repeat(3,1fr)}
.grid{grid-template-columns:repeat(3,1fr)}.grid.wide{grid-template-columns:repeat(2,1fr)}.grid.narrow{grid-template-columns:repeat(4,1fr)}
.meter{width:50px;margin-right:6px}svg,.badge{print-color-adjust:exact;-webkit-print-color-adjust:exact}}
)css";

constexpr std::string_view kScript = R"js(
'use strict';
const errors = [];
addEventListener('error', e => errors.push(e.message));
for (const box of document.querySelectorAll('.ab')) {
  const slider = box.querySelector('input');
  const follow = () => {
    box.style.setProperty('--cut', slider.value + '%');
    slider.setAttribute('aria-valuetext', Math.round(slider.value) + ' percent original');
  };
  slider.addEventListener('input', follow);
  follow();
  const mapped = box.parentElement.querySelector('.switch input');
  if (mapped) mapped.addEventListener('change', () => box.classList.toggle('mapped', mapped.checked));
  const taken = box.parentElement.querySelector('.taken');
  if (taken) taken.addEventListener('change', () => {
    box.classList.toggle('taken', taken.checked);
    box.querySelector('.tag.a').textContent = taken.checked ? 'Photograph' : 'Original';
  });
}
const look = document.getElementById('look');
for (const button of document.querySelectorAll('.copy')) button.addEventListener('click', () => {
  look.textContent = look.dataset.command + button.dataset.view;
  getSelection().selectAllChildren(look);
  if (navigator.clipboard) navigator.clipboard.writeText(look.textContent).then(() => button.textContent = 'copied', () => {});
});
function selfTest() {
  for (const image of document.images)
    if (!image.complete || image.naturalWidth === 0) errors.push('image does not load: ' + image.alt);
    else if (!image.alt) errors.push('image without a description');
  for (const link of document.querySelectorAll('a[href^="#"]'))
    if (!document.getElementById(link.hash.slice(1))) errors.push('link to nowhere: ' + link.hash);
  let sliders = 0;
  for (const box of document.querySelectorAll('.ab')) {
    const slider = box.querySelector('input'), over = box.querySelector('.over');
    for (const value of [0, 80, 50]) {
      slider.value = value;
      slider.dispatchEvent(new Event('input', {bubbles: true}));
      const cut = getComputedStyle(over).clipPath;
      if (!cut.includes(value + (value ? '%' : ''))) errors.push('slider at ' + value + ' cuts ' + cut);
    }
    if (!slider.getAttribute('aria-label')) errors.push('slider without a label');
    slider.focus();
    if (document.activeElement !== slider) errors.push('slider cannot be focused');
    const mapped = box.parentElement.querySelector('.switch input');
    if (mapped) {
      mapped.click();
      if (getComputedStyle(box.querySelector('.map')).visibility !== 'visible') errors.push('the map does not show');
      mapped.click();
    }
    const taken = box.parentElement.querySelector('.taken');
    if (taken) {
      taken.click();
      if (getComputedStyle(box.querySelector('.photo')).visibility !== 'visible') errors.push('the photograph does not show');
      taken.click();
    }
    ++sliders;
  }
  for (const button of document.querySelectorAll('.copy')) {
    button.click();
    if (!/^rgs-view .+ --view=./.test(look.textContent)) errors.push('no command but ' + look.textContent);
  }
  if (document.documentElement.scrollWidth > innerWidth + 1) errors.push('the page is wider than the window');
  const result = errors.length ? errors.join('; ') : 'ok';
  document.documentElement.dataset.selfTest = result + ', ' + document.images.length + ' images, ' + sliders + ' sliders';
}
addEventListener('load', () => { if (location.hash === '#self-test') selfTest(); });
)js";

// The source expression of a policy that admits exactly this text.
std::string allowed(std::string_view text) {
  return "'sha256-" + tool::base64(tool::sha256(text)) + "'";
}

}  // namespace

std::string html(std::string_view text) {
  std::string out;
  for (const char c : tool::escape_untrusted(text, false, 4096)) {
    switch (c) {
      case '&': out += "&amp;"; break;
      case '<': out += "&lt;"; break;
      case '>': out += "&gt;"; break;
      case '"': out += "&quot;"; break;
      case '\'': out += "&#39;"; break;
      default: out += c;
    }
  }
  return out;
}

std::string page_begin(std::string_view title) {
  std::string page = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n";
  page += "<meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\n";
  page +=
      "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; base-uri 'none'; form-action "
      "'none'; ";
  page += "img-src data:; style-src " + allowed(kStyle) + "; script-src " + allowed(kScript) + "\">\n";
  page += "<title>" + html(title) + "</title>\n<link rel=\"icon\" href=\"data:,\">\n<style>";
  page += kStyle;
  return page + "</style>\n</head>\n<body>\n";
}

std::string page_end() {
  std::string page = "<script>";
  page += kScript;
  return page + "</script>\n</body>\n</html>\n";
}

}  // namespace rgs::audit
