// Colours of the floor, dark and light.
import { onDark, rgb } from "./colors.js";

const LIGHT = {
  floor: "#efebe3",
  grid: "rgba(80, 70, 50, 0.09)",
  ink: "#1c1b19",
  quiet: "#66625b",
  faint: "rgba(80, 70, 50, 0.06)",
  casing: "rgba(30, 25, 20, 0.30)",
  goal: "rgba(40, 38, 34, 0.10)",
  box: "#b9b3a8",
  boxEdge: "#8d877b",
  human: "#1c1b19",
  head: "#d8cfc0",
  robot: "#26282c",
  nose: "#ffffff",
  focus: "#0a66d8",
  lidar: "rgba(10, 102, 216, 0.08)",
  lidarEdge: "rgba(10, 102, 216, 0.45)",
};

const DARK = {
  floor: "#191b1f",
  grid: "rgba(255, 255, 255, 0.055)",
  ink: "#edebe6",
  quiet: "#a29e96",
  faint: "rgba(255, 255, 255, 0.04)",
  casing: "rgba(0, 0, 0, 0.55)",
  goal: "rgba(255, 255, 255, 0.12)",
  box: "#4a4d54",
  boxEdge: "#6c7078",
  human: "#edebe6",
  head: "#8b8f97",
  robot: "#0e0f11",
  nose: "#ffffff",
  focus: "#79b0ff",
  lidar: "rgba(121, 176, 255, 0.09)",
  lidarEdge: "rgba(121, 176, 255, 0.5)",
};

/** The theme, with the colours of the objectives of a session's policy as `corners`. */
export function themeFor(session, dark) {
  const colors = session.policy.tunable.map((name) => rgb(session.contents.objectives[name].color));
  return { ...(dark ? DARK : LIGHT), dark, corners: dark ? colors.map(onDark) : colors };
}
