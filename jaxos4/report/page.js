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
  button.addEventListener("click", () => {
    root.dataset.theme = current() === "dark" ? "light" : "dark";
    name();
    document.dispatchEvent(new Event("theme"));
  });
  dark.addEventListener("change", () => {
    name();
    document.dispatchEvent(new Event("theme"));
  });
  name();
})();
