using UnityEngine;

namespace Nafir
{
    /// <summary>A source of sound in the server's scene. With a clip, the server plays it. Without one, the emitter sends the sound of the
    /// AudioSource on the same object, and silences it here: set its Spatial Blend to 2D.</summary>
    [AddComponentMenu("Audio/Nafir Emitter")]
    public sealed class NafirEmitter : MonoBehaviour
    {
        public NafirClient client;

        [Tooltip("One of GET /v1/clips; empty for the AudioSource on this object.")]
        public string clip = "";

        [Range(-80, 24)]
        public float gainDb;

        float[] mono = new float[0];
        string id;
        volatile NafirStream known; // the stream that has this emitter

        void OnEnable() => id = $"emitter{GetInstanceID()}";

        void OnDisable()
        {
            known?.RemoveEmitter(id);
            known = null;
        }

        void Update()
        {
            known = client != null ? client.Stream : null;
            known?.SetEmitter(id, new NafirSource { Clip = clip == "" ? null : clip, GainDb = gainDb, Pose = client.PoseOf(transform) });
        }

        // On the audio thread, if there is an AudioSource.
        void OnAudioFilterRead(float[] data, int channels)
        {
            var frames = data.Length / channels;
            if (mono.Length < frames) mono = new float[frames];
            for (int i = 0; i < frames; i++)
            {
                var sum = 0f;
                for (int channel = 0; channel < channels; channel++) sum += data[i * channels + channel];
                mono[i] = sum / channels;
            }
            known?.PushDry(id, mono, frames);
            System.Array.Clear(data, 0, data.Length);
        }
    }
}
