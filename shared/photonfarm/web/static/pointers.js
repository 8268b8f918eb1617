// Mouse, pen and fingers on a canvas. One of them turns, or slides with Shift or the right button; two fingers slide,
// and bring nearer as a wheel does.

export function listenToPointers(canvas, { turn, slide, approach }) {
  const held = new Map();
  let apart = 1;
  const spread = () => { const [a, b] = [...held.values()]; return Math.hypot(a.x - b.x, a.y - b.y) || 1; };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (held.size === 2) apart = spread();
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.x, dy = event.clientY - before.y;
    held.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (held.size === 2) {
      approach(apart / (apart = spread()));
      slide(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons === 2) slide(dx, dy);
    else turn(dx, dy);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => held.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    approach(Math.exp(event.deltaY / 700));
  }, { passive: false });
}
