// The page. The same script serves as the worker behind its previews.
import { Chooser } from "./choices/panel.js";
import { Hand } from "./recording/hand.js";
import { Recorder } from "./recording/panel.js";
import { Weights, byId, fillLists, showNumbers, showSetting, wordsOf } from "./view/controls.js";
import { dragOnFloor } from "./view/dragging.js";
import { Floor } from "./view/floor.js";
import { decode, encode } from "./view/link.js";
import { Session } from "./view/session.js";
import { themeFor } from "./view/theme.js";
import { Previews, serve } from "./view/worker.js";

const PAUSE_AT_THE_END = 1.8; // seconds, before it starts again
const NAMED = 4; // entries of a link that are not there
const HOW_TO_DRIVE = "Press and hold where the robot should go, or use the arrow keys";
const LEADS = {
  watch: "It drives to the flag by itself. Drag the dot and see how its way changes.",
  record: "You drive. What you record can become a style of the robot's own.",
  choose: "Say which of two drives you like better, and it finds what matters to you.",
};
const ENDINGS = {
  goal: ({ seconds, nearest }) =>
    `There in ${seconds.toFixed(1)} s, ${nearest.toFixed(2)} m from the person at the nearest`,
  human: () => "It touched the person",
  box: () => "It touched a box",
  time: () => "Not there after a minute",
};

function missing(refused) {
  const more = refused.length > NAMED ? ` and ${refused.length - NAMED} more` : "";
  return `The link has something that is not here: ${refused.slice(0, NAMED).join(", ")}${more}`;
}

function start() {
  const contents = JSON.parse(byId("contents").textContent);
  const session = new Session(contents);
  const floor = new Floor(byId("floor"), session);
  const hand = new Hand();
  const previews = new Previews(byId("program").textContent, contents);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  let theme;
  let ended = 0;

  const announce = (text) => (byId("status").textContent = text);
  /** The sentence under the title; `warns` where something was refused. */
  const lead = (text, warns = false) => {
    byId("lead").classList.toggle("warns", warns);
    return (byId("lead").textContent = text);
  };
  const verdict = (text) => {
    byId("verdict").textContent = text ?? "";
    byId("verdict").hidden = !text;
    if (text) announce(text);
  };
  // Browsers refuse an address that changes with every move of a pointer.
  let toWrite;
  const remember = () => {
    clearTimeout(toWrite);
    toWrite = setTimeout(writeAddress, 300);
  };
  const writeAddress = () => {
    clearTimeout(toWrite);
    const { sceneName: scene, seed, preference, policyName: policy, motion, moved } = session;
    const { log: answers, active: choosing } = chooser;
    const text = encode({ scene, seed, preference, policy, motion, moved, answers, choosing });
    window.history.replaceState(null, "", `#${text}`);
  };
  const ask = () => {
    if (chooser.active || !floor.show.previews || session.driver || session.episode.ending) return;
    const { episode, policyName: name, preference, clamped } = session;
    previews.ask({ moment: episode.moment(), name, preference, clamped });
  };

  const weights = new Weights(session, (preference) => {
    session.preference = preference;
    document.body.classList.remove("invite");
    weights.show();
    remember();
    ask();
  });
  const paint = () => {
    const isDark = (document.documentElement.dataset.theme ??= dark.matches ? "dark" : "light");
    theme = themeFor(session, isDark === "dark");
    weights.build(theme.corners);
    floor.labels = wordsOf(session);
  };
  const showPlay = () => (byId("play").textContent = session.playing ? "Pause" : "Go on");
  /** Everything on the page follows the session. */
  const follow = () => {
    previews.forget();
    paint();
    showSetting(session);
    floor.fit();
    remember();
    ask();
  };

  session.onStep = () => {
    if (session.driver && session.episode.elapsed === 1) verdict(null);
    recorder.step();
    ask();
  };
  session.onRestart = () => {
    ended = 0;
    verdict(session.driver ? HOW_TO_DRIVE : null);
    previews.forget();
    recorder.begin();
    ask();
  };
  const recorder = new Recorder(session, hand, { announce: verdict });
  const chooser = new Chooser(session, {
    announce,
    onChange: remember,
    onDrive: (preference, policy) => {
      if (session.policy.tunable.join() !== session.policies[policy].tunable.join()) session.setPolicy(policy);
      session.preference = preference;
      document.body.classList.remove("invite");
      setMode("watch");
      const parts = wordsOf(session).map((word, entry) => `${word} ${Math.round(100 * preference[entry])} %`);
      announce(lead(`It drives as you chose: ${parts.join(", ")}.`));
      byId("play").focus({ preventScroll: true });
      window.scrollTo({ top: 0 });
    },
  });
  let mode = "watch";
  let recorded;
  /** Who does what: "watch" (it drives), "record" (you drive) or "choose". */
  const setMode = (name) => {
    const recording = mode === "record" || name === "record";
    // Who comes back to drive does not begin with the same scenes again.
    if (mode === "record" && session.sceneName === "empty") recorded = session.seed;
    mode = name;
    for (const id of Object.keys(LEADS)) byId(id).setAttribute("aria-pressed", id === mode);
    lead(LEADS[mode]);
    byId("hint").hidden = mode === "record";
    // Time waits for the driver: nothing to pause.
    byId("play").hidden = mode === "record";
    chooser.show(mode === "choose");
    if (recording) recorder.show(mode === "record");
    session.playing = true;
    showPlay();
    if (mode === "record" && contents.scenes.empty) session.select("empty", recorded);
    else session.restart();
    follow();
  };
  for (const id of Object.keys(LEADS)) byId(id).addEventListener("click", () => mode === id || setMode(id));

  dragOnFloor(floor, session, {
    hand,
    driving: () => recorder.active,
    announce,
    onMoved: () => {
      remember();
      ask();
    },
  });
  wire({ session, floor, hand, recorder, chooser, weights, follow, showPlay, ask, announce, dark, paint, writeAddress });

  const known = {
    scenes: contents.scenes,
    policies: Object.fromEntries(
      Object.entries(session.policies).map(([name, policy]) => [name, policy.tunable.length]),
    ),
    choices: Boolean(contents.choices),
  };
  const open = () => {
    const { sceneName: scene, seed, policyName: policy } = session;
    const { state, refused } = decode(window.location.hash, { ...known, present: { scene, seed, policy } });
    if (state.scene || state.seed !== undefined) {
      session.select(state.scene ?? session.sceneName, state.seed);
    }
    if (state.motion) session.setMotion(state.motion);
    if (state.policy) session.setPolicy(state.policy);
    if (state.preference) session.preference = state.preference;
    for (const [name, place] of Object.entries(state.moved)) session.move(name, ...place);
    session.restart();
    chooser.restore(state.answers ?? "");
    if (Boolean(state.choosing) !== (mode === "choose")) setMode(state.choosing ? "choose" : "watch");
    lead(LEADS[mode]);
    if (refused.length) announce(lead(missing(refused), true));
    follow();
  };
  window.addEventListener("hashchange", open);

  fillLists(session);
  session.playing = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  showPlay();
  document.body.classList.add("invite");
  open();

  let before = performance.now();
  const frame = (now) => {
    // A page in the background stands still.
    const passed = Math.min(Math.max(now - before, 0) / 1000, 0.1);
    if (chooser.active) {
      before = now;
      chooser.draw(theme, passed);
      requestAnimationFrame(frame);
      return;
    }
    session.tick(passed);
    if (session.over && session.playing) {
      if (!ended) {
        ended = now;
        if (!recorder.active) verdict(ENDINGS[session.episode.ending](session));
      } else if (now - ended > 1000 * PAUSE_AT_THE_END) {
        if (recorder.active) {
          session.next();
          follow();
        } else session.restart();
      }
    }
    before = now;
    floor.target = hand.target;
    floor.draw(theme, previews);
    showNumbers(session);
    requestAnimationFrame(frame);
  };
  new ResizeObserver(() => {
    floor.fit();
    paint();
  }).observe(byId("floor"));
  requestAnimationFrame(frame);
  // For tests, and for the curious.
  window.page = { session, floor, previews, recorder, chooser };
}

/** Buttons, lists and keys. */
function wire({ session, floor, hand, recorder, chooser, weights, follow, showPlay, ask, announce, dark, paint, writeAddress }) {
  const on = (id, event, action) => byId(id).addEventListener(event, action);
  const play = () => {
    session.playing = !session.playing;
    showPlay();
  };
  const again = () => session.restart();
  const next = () => {
    session.next();
    follow();
  };
  on("play", "click", play);
  on("again", "click", again);
  on("next", "click", next);
  on("pace", "change", (event) => (session.pace = Number(event.target.value)));
  on("scene", "change", (event) => {
    session.select(event.target.value);
    follow();
  });
  on("seed", "change", (event) => {
    session.select(session.sceneName, Math.round(Number(event.target.value)) || undefined);
    follow();
  });
  on("motion", "change", (event) => {
    session.setMotion(event.target.value);
    session.restart();
    follow();
  });
  on("policy", "change", (event) => {
    session.setPolicy(event.target.value);
    follow();
  });
  const toggles = { previews: "KeyP", demonstration: "KeyD", lidar: "KeyL" };
  for (const name of Object.keys(toggles)) {
    on(`show-${name}`, "change", (event) => {
      floor.show[name] = event.target.checked;
      ask();
    });
  }
  on("show-numbers", "change", (event) => (byId("numbers").hidden = !event.target.checked));
  on("link", "click", async () => {
    writeAddress();
    try {
      await navigator.clipboard.writeText(window.location.href);
      byId("link").textContent = "Copied";
    } catch {
      byId("link").textContent = "It is in the address bar";
    }
    setTimeout(() => (byId("link").textContent = "Copy a link to this"), 2500);
  });
  on("theme", "click", () => {
    const root = document.documentElement;
    root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
    paint();
  });
  dark.addEventListener("change", () => {
    delete document.documentElement.dataset.theme;
    paint();
  });
  on("help", "click", () => byId("help-dialog").showModal());

  hand.stick = () => {
    const pad = navigator.getGamepads?.().find((one) => one?.connected);
    return pad ? [pad.axes[0], pad.axes[1]] : null;
  };
  const corner = (entry) => session.preference.map((_, index) => (index === entry ? 1 : 0));
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || byId("help-dialog").open) return;
    const typing = event.target.closest?.("input[type=number], select");
    if (typing) return;
    if (recorder.active && hand.key(event.code, true)) return event.preventDefault();
    // A button that is pressed by Space, or a slider that arrows move, does that.
    const taken = event.target.closest?.("button, input");
    if (chooser.active) {
      if (event.code === "Space" && taken) return;
      if (chooser.key(event)) event.preventDefault();
      return;
    }
    if (event.code === "Space" && !taken) {
      if (!recorder.active) play();
    }
    else if (event.code === "KeyR") again();
    else if (event.code === "KeyN") next();
    else if (/^[0-9]$/.test(event.key) && Number(event.key) <= session.preference.length) {
      const entry = Number(event.key);
      const even = session.preference.map(() => 1 / session.preference.length);
      weights.onChange(entry ? corner(entry - 1) : even);
      announce(entry ? `${wordsOf(session)[entry - 1]} alone` : "all the same");
    } else {
      const name = Object.keys(toggles).find((one) => toggles[one] === event.code);
      if (!name) return;
      byId(`show-${name}`).click();
    }
    event.preventDefault();
  });
  window.addEventListener("keyup", (event) => hand.key(event.code, false));
  window.addEventListener("blur", () => hand.release());
}

if (typeof document === "undefined") serve(self);
else start();
