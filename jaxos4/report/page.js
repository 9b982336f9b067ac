"use strict";
(() => {
  const root = document.documentElement;

  // A browser that goes back to the page restores checkboxes and lists: apply each control once at the start.
  function connect(controls, apply) {
    for (const control of controls) {
      control.addEventListener("change", () => apply(control));
      apply(control);
    }
  }

  connect(document.querySelectorAll("[data-toggles]"), (checkbox) => {
    for (const element of document.querySelectorAll(`[data-estimator="${checkbox.dataset.toggles}"]`)) {
      element.style.display = checkbox.checked ? "" : "none";
    }
  });

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const current = () => root.dataset.theme || (dark.matches ? "dark" : "light");
  const name = () => {
    button.textContent = current() === "dark" ? "Light" : "Dark";
    button.setAttribute("aria-label", `Switch to ${button.textContent.toLowerCase()} colours`);
  };
  const show = (theme) => {
    if (theme) root.dataset.theme = theme;
    else delete root.dataset.theme;
    name();
    document.dispatchEvent(new Event("theme"));
  };
  button.addEventListener("click", () => show(current() === "dark" ? "light" : "dark"));
  dark.addEventListener("change", () => show(root.dataset.theme));
  // Paper is white.
  let chosen;
  addEventListener("beforeprint", () => {
    chosen = root.dataset.theme;
    show("light");
  });
  addEventListener("afterprint", () => show(chosen));
  name();
})();
