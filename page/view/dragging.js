// Taking hold of what is on the floor: with a pointer, or with keys.

const STEP = 0.1; // metres an arrow key
const ARROWS = { ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] };

/** A pointer moves things of the floor, or, where somebody drives by hand, leads the robot. */
export function dragOnFloor(floor, session, { hand, driving, onMoved, announce }) {
  const { canvas } = floor;
  let held = null;
  const place = (event) => {
    const frame = canvas.getBoundingClientRect();
    return [event.clientX - frame.left, event.clientY - frame.top];
  };

  canvas.addEventListener("pointerdown", (event) => {
    const [px, py] = place(event);
    if (driving()) hand.target = floor.metres(px, py);
    else {
      const name = floor.thingAt(px, py);
      if (!name) return;
      const [x, y] = floor.metres(px, py);
      const [ox, oy] = whereIs(session, name);
      held = { name, offset: [ox - x, oy - y] };
      floor.selected = name;
      canvas.style.cursor = "grabbing";
    }
    canvas.setPointerCapture(event.pointerId);
    event.preventDefault();
    // A frame around the floor is for keys.
    canvas.focus({ preventScroll: true, focusVisible: false });
  });
  canvas.addEventListener("pointermove", (event) => {
    const [px, py] = place(event);
    if (driving()) {
      if (hand.target) hand.target = floor.metres(px, py);
      return;
    }
    if (!held) {
      canvas.style.cursor = floor.thingAt(px, py) ? "grab" : "";
      return;
    }
    const [x, y] = floor.metres(px, py);
    session.move(held.name, ...floor.inside(held.name, [x + held.offset[0], y + held.offset[1]]));
    onMoved();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, () => {
      hand.target = null;
      if (!held) return;
      held = null;
      floor.selected = null;
      canvas.style.cursor = "";
      onMoved();
    });
  }
  // Pages scroll by touch, but not where a finger is on something.
  canvas.addEventListener(
    "touchstart",
    (event) => {
      const frame = canvas.getBoundingClientRect();
      const { clientX, clientY } = event.touches[0];
      const on = floor.thingAt(clientX - frame.left, clientY - frame.top);
      if (driving() || on) event.preventDefault();
    },
    { passive: false },
  );

  canvas.addEventListener("keydown", (event) => {
    if (driving()) return;
    if (event.key === "Enter") {
      const names = session.movable;
      const step = event.shiftKey ? -1 : 1;
      const index = names.indexOf(floor.selected);
      const next = index < 0 ? 0 : index + step;
      floor.selected = names[next] ?? null;
      announce(floor.selected ? `${spoken(floor.selected)}: arrow keys move it` : "nothing is held");
    } else if (event.key === "Escape") floor.selected = null;
    else if (floor.selected && event.key in ARROWS) {
      const [dx, dy] = ARROWS[event.key].map((one) => one * (event.shiftKey ? 5 : 1) * STEP);
      const [x, y] = whereIs(session, floor.selected);
      session.move(floor.selected, ...floor.inside(floor.selected, [x + dx, y + dy]));
      onMoved();
    } else return;
    event.preventDefault();
    event.stopPropagation();
  });
  canvas.addEventListener("blur", () => {
    if (!held) floor.selected = null;
  });
}

function whereIs({ episode }, name) {
  if (name === "human") return episode.human;
  return name === "goal" ? episode.goal : episode.boxes[Number(name.slice(3))];
}

function spoken(name) {
  if (name === "human") return "the person";
  return name === "goal" ? "the goal" : `box ${Number(name.slice(3)) + 1}`;
}
