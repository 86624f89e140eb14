"""The steps of a frame as one HTML page, without other files or hosts."""

from collections.abc import Sequence
from html import escape

_STYLE = (
    "html,body{margin:0;height:100%;background:#14171c;color:#e8ebf0;"
    "font:15px Inter,'Segoe UI','Helvetica Neue',Arial,sans-serif}"
    "body{display:flex;flex-direction:column}main{flex:1;min-height:0}"
    "main svg{display:none;width:100%;height:100%}main svg.now{display:block}"
    "nav{display:flex;gap:12px;align-items:center;padding:10px 36px}nav input{flex:1;accent-color:#389cff}"
    "button{background:#262c35;color:inherit;border:0;border-radius:6px;padding:8px 16px;font:inherit}"
    "button:hover{background:#39424f}[data-step]{cursor:pointer}"
)
_SCRIPT = """
const steps = [...document.querySelectorAll("main > svg")], slider = document.querySelector("input");
let now = 0;
function show(number) {
  now = Math.min(Math.max(number, 0), steps.length - 1);
  steps.forEach((step, n) => step.classList.toggle("now", n === now));
  slider.value = now + 1;
}
document.addEventListener("keydown", (event) => {
  const to = {ArrowLeft: now - 1, ArrowRight: now + 1, Home: 0, End: steps.length - 1}[event.key];
  if (to === undefined) return;
  event.preventDefault();
  show(to);
});
document.addEventListener("click", (event) => {
  const node = event.target.closest("[data-step]"), button = event.target.closest("button");
  if (node) show(node.dataset.step - 1);
  if (button) show(now + Number(button.value));
});
slider.addEventListener("input", () => show(slider.value - 1));
show(0);
"""


def page(title: str, pictures: Sequence[str]) -> str:
    """Return a page that shows one SVG picture at a time.

    Parameters
    ----------
    title : str
        Of the page.
    pictures : sequence of str
        Of all steps, in order.
    """
    shown = "".join(pictures) or "<p>Nothing was split, and nothing was merged.</p>"
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body><main>{shown}</main><nav>"
        '<button value="-1">← back</button>'
        f'<input type="range" min="1" max="{max(len(pictures), 1)}" value="1" aria-label="step">'
        f'<button value="1">next →</button></nav><script>{_SCRIPT}</script></body></html>'
    )


def framed(document: str) -> str:
    """Return a page within a frame, so that a notebook shows it without applying its own style."""
    return f'<iframe srcdoc="{escape(document)}" style="width:100%;aspect-ratio:3/2;border:0"></iframe>'
