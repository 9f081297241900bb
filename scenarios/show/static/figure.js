// Filters of tables; and draws the page's Plotly figures in the colours of the page, with room for their legends at any width.
"use strict";

// Fields that show only the rows of their table that have all the words.
function startFilters() {
  for (const filter of document.querySelectorAll("input.filter")) filter.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/);
    for (const row of document.getElementById(filter.dataset.table).querySelectorAll("tbody tr"))
      row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
  });
}

// Draws every element with `data-drawn` from the JSON in the element of that id; returns all.
async function drawFigures(options) {
  await runLibrary("plotly");
  const elements = [...document.querySelectorAll("[data-drawn]")];
  for (const element of elements) await drawFigure(element, options);
  return elements;
}

async function drawFigure(element, options) {
  const drawn = JSON.parse(document.getElementById(element.dataset.drawn).textContent);
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
  // The layout leaves room for a legend of a wide page; on a narrow one the figure begins lower, and takes the width.
  const room = drawn.layout.margin, aside = (drawn.layout.annotations || []).flatMap((each, i) => (each.x === 1 ? [[i, each]] : []));
  let last = 0;
  // Margins, and the labels of limits: beside a wide figure, inside a narrow one.
  function sides(narrow) {
    const out = { "margin.l": narrow ? Math.min(room.l, 46) : room.l, "margin.r": narrow ? Math.min(room.r, 10) : room.r };
    for (const [i, { xanchor, xshift, yanchor, yshift }] of aside)
      Object.entries(narrow ? { xanchor: "right", xshift: 0, yanchor: "bottom", yshift: 1 } : { xanchor, xshift, yanchor, yshift })
        .forEach(([name, value]) => { out[`annotations[${i}].${name}`] = value; });
    return out;
  }
  async function fit() {
    const legend = element.querySelector(".legend");
    if (!legend || element.clientWidth === last) return;
    last = element.clientWidth;
    const narrow = last < 600;
    if (narrow || element.layout.margin.l !== room.l) await Plotly.relayout(element, sides(narrow));
    const needed = element.querySelector(".legend").getBoundingClientRect().height + 20;
    const margin = Math.max(room.t, Math.ceil(needed));
    if (Math.abs(margin - element.layout.margin.t) > 4)
      await Plotly.relayout(element, { "margin.t": margin, height: drawn.layout.height + margin - room.t });
  }
  await fit();
  element.on("plotly_afterplot", fit);
}
