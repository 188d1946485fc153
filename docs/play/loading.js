// Loads a scene and its policy from a folder of files; used by the page and by tools/play_check.mjs.
import { Episode, Physics, Policy } from './episode.js';

/**
 * Returns an episode, not yet reset.
 * @param read function of a file's name that resolves to its bytes (Uint8Array).
 * @param loadMujoco the loader that `@mujoco/mujoco` exports.
 * @param ort the module of `onnxruntime-web`.
 */
export async function loadEpisode(read, loadMujoco, ort) {
  const text = async (name) => new TextDecoder().decode(await read(name));
  ort.env.wasm.numThreads = 1; // threads would need headers that a plain file server does not send
  const [mujoco, xml, settings, onnx] = await Promise.all([
    loadMujoco(),
    text('scene.xml'),
    text('scene.json').then(JSON.parse),
    read('policy.onnx'),
  ]);
  const session = await ort.InferenceSession.create(onnx);
  const policy = new Policy(ort, session, settings.policy);
  return new Episode(new Physics(mujoco, xml, settings), policy);
}
