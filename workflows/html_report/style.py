"""Looks and behaviour of the page."""

STYLE = """
:root{color-scheme:light dark;--ink:#1c2127;--soft:#4a5560;--line:#d5dae0;--paper:#fff;--link:#00558c;--key:#eef3f8;
--edge:#b9c8d6;--box:#f4f6f8;--none:#000}
@media(prefers-color-scheme:dark){:root{--ink:#e6e9ec;--soft:#aab4be;--line:#3a434c;--paper:#14181d;--link:#8cc8ff;
--key:#1f2a35;--edge:#46586a;--box:#1c2229;--none:#fff}}
*{box-sizing:border-box}body{margin:0;font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper)}
main{max-width:1280px;margin:0 auto;padding:1rem}h1{font-size:1.6rem;margin:.2rem 0;overflow-wrap:anywhere}
h2{font-size:1.2rem;margin:1.6rem 0 .5rem;border-bottom:1px solid var(--line)}header h2{border:0;margin:.8rem 0 .2rem}
.lead{font-size:1.25rem;margin:.2rem 0}.tiles{display:flex;flex-wrap:wrap;gap:.6rem}
.tile{border:1px solid var(--line);border-left:6px solid var(--soft);padding:.3rem .8rem}.tile strong{font-size:1.4rem}
.tile.success{border-left-color:#009e73}.tile.failed{border-left-color:#d55e00}
.tile.conflicted{border-left-color:#cc79a7}.tile.error{border-left-color:var(--none)}
.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,520px),1fr));gap:1rem}
figure{margin:0;min-width:0}figcaption{color:var(--soft);font-size:.9rem}
nav{display:flex;flex-wrap:wrap;gap:.2rem 1rem;margin:.8rem 0}a{color:var(--link)}
.strip{display:flex;flex-wrap:wrap;gap:.6rem;margin:.6rem 0}
.thumbnail{display:flex;flex-direction:column;width:min(47%,190px);padding:.2rem}
.thumbnail img{width:100%;height:170px;object-fit:contain}.thumbnail span{overflow-wrap:anywhere}
.wide{overflow-x:auto;margin:.6rem 0}table{border-collapse:collapse;font-size:.9rem}
caption{text-align:left;color:var(--soft);padding:.2rem 0}
th,td{text-align:left;vertical-align:top;padding:.25rem .6rem;border-bottom:1px solid var(--line)}
button{font:inherit;color:var(--link);background:var(--key);border:1px solid var(--edge);border-radius:4px;
padding:.05rem .4rem;cursor:pointer}button.image{font-size:.85rem;margin:.1rem}button:focus-visible,
.wide:focus-visible,pre:focus-visible,a:focus-visible
{outline:3px solid #0072b2;outline-offset:1px}
pre{overflow:auto;max-height:24rem;background:var(--box);padding:.6rem;font-size:.8rem}
dialog{color:var(--ink);background:var(--paper)}
dialog{max-width:min(96vw,900px);border:1px solid var(--line);padding:1rem}dialog img{max-width:100%}
dialog::backdrop{background:rgba(0,0,0,.5)}
"""

SCRIPT = """
"use strict";
const {pictures, address} = JSON.parse(document.getElementById("data").textContent);
const dialog = document.getElementById("picture");
function show(id) {
  document.getElementById("picture-title").textContent = id;
  const body = document.getElementById("picture-body");
  body.replaceChildren();
  const picture = document.createElement("img");
  picture.alt = "Summary picture of " + id;
  picture.onerror = () => {
    const said = document.createElement("p");
    said.textContent = "No picture beside this report: pilotage picture RUN " + id;
    body.replaceChildren(said);
  };
  picture.src = pictures[id] || address + "/" + encodeURIComponent(id) + ".png";
  body.append(picture);
  dialog.showModal();
}
// The file holds each picture once, for the dialog too.
for (const button of document.querySelectorAll(".thumbnail"))
  button.querySelector("img").src = pictures[button.dataset.image];
document.addEventListener("click", (event) => {
  const button = event.target.closest("button.image");
  if (button) show(button.dataset.image);
});
const dark = matchMedia("(prefers-color-scheme: dark)");
function tints() {
  const style = getComputedStyle(document.documentElement);
  const ink = style.getPropertyValue("--ink"), line = style.getPropertyValue("--line");
  return {"font.color": ink, "xaxis.gridcolor": line, "yaxis.gridcolor": line};
}
// The whole page is laid out by now: each figure is drawn once, at its final width and in its final colours.
const {"font.color": ink, "xaxis.gridcolor": line} = tints();
for (const plot of document.querySelectorAll(".plot")) {
  const {data, layout} = JSON.parse(plot.nextElementSibling.textContent);
  layout.font.color = ink;
  // A square map needs no more height than a narrow page's width and its key.
  if (layout.yaxis.scaleanchor) {
    layout.height = Math.min(layout.height, plot.clientWidth + 130);
    plot.style.height = layout.height + "px";
  }
  layout.xaxis.gridcolor = layout.yaxis.gridcolor = line;
  Plotly.newPlot(plot, data, layout, {displaylogo: false, responsive: true});
  plot.on("plotly_click", (event) => {
    // A figure over spells of time has no image under the pointer.
    const id = event.points[0].customdata;
    if (typeof id === "string") show(id);
  });
}
dark.addEventListener("change", () => {
  for (const plot of document.querySelectorAll(".plot")) Plotly.relayout(plot, tints());
});
"""
