"use strict";
// Draws the figures one after the other, so that the page can be read while they come.
(() => {
  const root = document.documentElement;
  const page = JSON.parse(document.getElementById("data").textContent);
  const config = {
    responsive: true, displaylogo: false, showTips: false,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  };
  const chosen = page.figures.map(() => 0);
  root.dataset.figures = page.figures.length;
  root.dataset.drawn = 0;
  root.dataset.failed = 0;

  // References to the shared arrays become the arrays.
  const resolve = (value) => {
    if (Array.isArray(value)) return value.map(resolve);
    if (value === null || typeof value !== "object") return value;
    if ("$" in value) return page.arrays[value.$];
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, resolve(item)]));
  };

  const fail = (element, error) => {
    root.dataset.failed = Number(root.dataset.failed) + 1;
    element.classList.add("failed");
    element.textContent = "This figure could not be drawn here: " + error;
  };

  const draw = async (number) => {
    const figure = page.figures[number];
    const element = document.getElementById("plot" + number);
    try {
      await Plotly.react(element, resolve(figure.choices[chosen[number]].traces), resolve(figure.layout), config);
    } catch (error) {
      fail(element, error);
    }
  };

  const choose = (number, index) => {
    chosen[number] = index;
    const select = document.querySelector(`select[data-figure="${number}"]`);
    if (select) select.value = index;
    return draw(number);
  };

  // Figures of one group, with the same number of choices, follow each other.
  for (const select of document.querySelectorAll("select[data-figure]")) {
    select.addEventListener("change", () => {
      const number = Number(select.dataset.figure);
      const { group, choices } = page.figures[number];
      page.figures.forEach((other, index) => {
        const follows = group && other.group === group && other.choices.length === choices.length;
        if (index === number || follows) choose(index, Number(select.value));
      });
    });
  }

  // A folded table is printed as well.
  addEventListener("beforeprint", () => {
    for (const element of document.querySelectorAll("details")) element.open = true;
  });

  const drawFrom = async (number) => {
    if (number >= page.figures.length) return;
    await draw(number);
    root.dataset.drawn = Number(root.dataset.drawn) + 1;
    setTimeout(() => drawFrom(number + 1), 0);
  };
  drawFrom(0);
})();
