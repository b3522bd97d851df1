// The state of a session in the part of an address behind #, and back.

const MOTIONS = ["stands", "walks", "crosses"];
/** What may be typed in a dialogue, see choices/dialogue.js. */
const ANSWERS = /^[12=nus]{1,200}$/;

// Nothing between two commas is no number, whatever Number says of it.
function numbers(text) {
  const values = text.split(",").map((one) => (one.trim() ? Number(one) : NaN));
  return values.every(Number.isFinite) ? values : null;
}

/** What a session is set to, as text. */
export function encode(state) {
  const out = new URLSearchParams();
  out.set("scene", state.scene);
  out.set("seed", state.seed);
  out.set("weights", state.preference.map((weight) => Number(weight.toFixed(3))).join(","));
  out.set("policy", state.policy);
  out.set("person", state.motion);
  for (const [name, [x, y]] of Object.entries(state.moved)) {
    out.set(name, `${x.toFixed(2)},${y.toFixed(2)}`);
  }
  if (state.answers) out.set("answers", state.answers);
  if (state.choosing) out.set("view", "choices");
  return out.toString().replaceAll("%2C", ",").replaceAll("%3D", "=");
}

/**
 * What a text says, as far as it says something that there is; the rest is named in `refused`.
 *
 * `known` has `scenes`, name to { first_seed, scenes }, `policies`, name to the number of weights, `choices`, whether
 * there are drives to choose from, and `present`, { scene, seed, policy }, which stay where the text names no others.
 */
export function decode(text, known) {
  const state = { moved: {} };
  const refused = [];
  for (const [name, value] of new URLSearchParams(text.replace(/^#/, ""))) {
    const refuse = () => refused.push(`${name}=${value}`.slice(0, 40));
    if (name === "scene" && Object.hasOwn(known.scenes, value)) state.scene = value;
    else if (name === "seed" && /^\d{1,9}$/.test(value)) state.seed = Number(value);
    else if (name === "policy" && Object.hasOwn(known.policies, value)) state.policy = value;
    else if (name === "answers" && known.choices && ANSWERS.test(value)) state.answers = value;
    else if (name === "view" && known.choices && value === "choices") state.choosing = true;
    else if (name === "person" && MOTIONS.includes(value)) state.motion = value;
    else if (name === "weights") {
      const weights = numbers(value);
      const total = weights?.reduce((sum, one) => sum + one, 0);
      if (total > 0 && Number.isFinite(total) && weights.every((one) => one >= 0)) {
        state.preference = weights.map((one) => one / total);
      } else refuse();
    } else if (/^(human|goal|box\d)$/.test(name)) {
      const place = numbers(value);
      if (place?.length === 2 && place.every((one) => Math.abs(one) <= 20)) state.moved[name] = place;
      else refuse();
    } else refuse();
  }
  // What depends on another entry.
  const { present } = known;
  const scene = known.scenes[state.scene ?? present.scene];
  const last = scene.first_seed + scene.scenes.length - 1;
  if (state.seed !== undefined && (state.seed < scene.first_seed || state.seed > last)) {
    refused.push(`seed=${state.seed}`);
    delete state.seed;
  }
  const stays = !state.scene || state.scene === present.scene;
  const seed = state.seed ?? (stays ? present.seed : scene.first_seed);
  const { boxes } = scene.scenes[seed - scene.first_seed];
  for (const name of Object.keys(state.moved)) {
    if (name.startsWith("box") && Number(name.slice(3)) >= boxes.length) {
      refused.push(`${name}=${state.moved[name]}`);
      delete state.moved[name];
    }
  }
  const weights = known.policies[state.policy ?? present.policy];
  if (state.preference && state.preference.length !== weights) {
    refused.push("weights");
    delete state.preference;
  }
  return { state, refused };
}
