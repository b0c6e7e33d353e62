/** An AudioNode with the sound of a microphone, without the processing that telephones need. Asks the user. */
export async function microphone(context, constraints = {}) {
  const raw = { echoCancellation: false, noiseSuppression: false, autoGainControl: false };
  const stream = await navigator.mediaDevices.getUserMedia({ audio: { ...raw, ...constraints } });
  return context.createMediaStreamSource(stream);
}
