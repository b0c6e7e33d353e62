using System;
using UnityEngine;

namespace Nafir
{
    /// <summary>A source of sound in the server's scene. With a clip, the server plays it. Without one, the emitter sends the sound of the
    /// AudioSource on the same object, and silences it here: set its Spatial Blend to 2D. A <see cref="NafirMicrophone"/> may take its
    /// place.</summary>
    [AddComponentMenu("Audio/Nafir Emitter")]
    public sealed class NafirEmitter : MonoBehaviour
    {
        public NafirClient client;

        [Tooltip("One of GET /v1/clips; empty for the AudioSource on this object.")]
        public string clip = "";

        [Tooltip("Whether the clip begins again when it is over.")]
        public bool loop = true;

        [Tooltip("Whether it is heard from the beginning. Else call Play.")]
        public bool playOnEnable = true;

        [Range(-80, 24)]
        public float gainDb;

        float[] mono = new float[0];
        string id;
        int plays;
        bool wanted;
        NafirClient listened; // whose events this emitter hears
        volatile NafirStream known; // the stream that has this emitter

        /// <summary>The clip is over, with its reverberation.</summary>
        public event Action Ended;

        public bool IsPlaying => wanted;

        void OnEnable()
        {
            if (playOnEnable) Play();
        }

        void OnDisable()
        {
            Leave();
            if (listened != null) listened.EmitterEnded -= OnEmitterEnded;
            listened = null;
        }

        /// <summary>Plays the clip from its beginning, or begins to send.</summary>
        public void Play()
        {
            Leave();
            id = $"emitter{GetInstanceID()}.{++plays}"; // what is still to be said of the last one is not about this one
            wanted = true;
        }

        /// <summary>Lets the clip fade out; <see cref="Ended"/> follows. An emitter without one is silent at once.</summary>
        public void Stop(float fadeS = 0.01f)
        {
            if (!wanted) return;
            if (clip == "") Leave();
            else known?.StopEmitter(id, fadeS: fadeS);
        }

        void Leave()
        {
            known?.RemoveEmitter(id);
            known = null;
            wanted = false;
        }

        void Update()
        {
            if (listened != client)
            {
                if (listened != null) listened.EmitterEnded -= OnEmitterEnded;
                listened = client;
                if (listened != null) listened.EmitterEnded += OnEmitterEnded;
            }
            if (!wanted) return;
            var stream = client != null ? client.Stream : null;
            if (stream != null)
            {
                var source = new NafirSource { Clip = clip == "" ? null : clip, GainDb = gainDb, Loop = loop, Pose = client.PoseOf(transform), RemoveWhenEnded = true };
                if (stream == known) stream.ChangeEmitter(id, source); // one that has ended does not begin again before it is told
                else stream.SetEmitter(id, source);
            }
            known = stream;
        }

        void OnEmitterEnded(string ended)
        {
            if (ended != id) return;
            wanted = false;
            known = null;
            Ended?.Invoke();
        }

        /// <summary>Sends samples at the game's sample rate, in place of an AudioSource. May be called on any thread.</summary>
        public void Push(float[] samples, int frames) => known?.PushDry(id, samples, frames);

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
            Push(mono, frames);
            System.Array.Clear(data, 0, data.Length);
        }
    }
}
