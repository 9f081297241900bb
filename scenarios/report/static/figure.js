// Filters of tables; and draws the page's Plotly figure in the colours of the page, with room for its legends at any width.
"use strict";

// Fields that show only the rows of their table that have all the words.
function startFilters() {
  for (const filter of document.querySelectorAll("input.filter")) filter.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/);
    for (const row of document.getElementById(filter.dataset.table).querySelectorAll("tbody tr"))
      row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
  });
}

async function drawFigure(options) {
  await runLibrary("plotly");
  const drawn = JSON.parse(document.getElementById("drawn").textContent), element = document.getElementById("figure");
  const dark = matchMedia("(prefers-color-scheme: dark)");
  function colours() {
    const style = getComputedStyle(document.body), out = {
      "font.color": style.color, paper_bgcolor: style.backgroundColor, plot_bgcolor: style.backgroundColor,
      "hoverlabel.bgcolor": style.backgroundColor, "hoverlabel.font.color": style.color,
    };
    for (const axis of Object.keys(drawn.layout).filter((key) => /^[xy]axis/.test(key)))
      out[`${axis}.gridcolor`] = dark.matches ? "#33373c" : "#e6e6e6";
    return out;
  }
  await Plotly.newPlot(element, drawn.data, drawn.layout, options);
  if (dark.matches) await Plotly.relayout(element, colours());
  dark.addEventListener("change", () => Plotly.relayout(element, colours()));
  // The layout leaves room for a legend of a wide page; on a narrow one the figure begins lower.
  const room = drawn.layout.margin.t;
  let last = 0;
  async function fit() {
    const legend = element.querySelector(".legend");
    if (!legend || element.clientWidth === last) return;
    last = element.clientWidth;
    const narrow = last < 600; // the time axis of the work has the title of the one below
    const needed = legend.getBoundingClientRect().height + 50;
    const margin = Math.max(room, Math.ceil(needed));
    if (narrow || Math.abs(margin - element.layout.margin.t) > 4)
      await Plotly.relayout(element, {
        "margin.t": margin, height: drawn.layout.height + margin - room,
        "legend2.font.size": narrow ? 9 : 12, "xaxis.title.text": narrow ? "" : drawn.layout.xaxis2.title.text,
      });
  }
  await fit();
  element.on("plotly_afterplot", fit);
  return element;
}
