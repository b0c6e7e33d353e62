using UnityEngine;

namespace Nafir
{
    /// <summary>Sends a microphone to the scene through the emitter on the same object, which has no clip and no AudioSource.</summary>
    [AddComponentMenu("Audio/Nafir Microphone")]
    [RequireComponent(typeof(NafirEmitter))]
    public sealed class NafirMicrophone : MonoBehaviour
    {
        const int RingS = 1; // what a game that draws too slowly may be late

        [Tooltip("One of Microphone.devices; empty for the usual one.")]
        public string device = "";

        NafirEmitter emitter;
        AudioClip recording;
        float[] samples = new float[0];
        int taken; // position in the recording, a ring

        string Device => device == "" ? null : device;

        void OnEnable()
        {
            emitter = GetComponent<NafirEmitter>();
            recording = Microphone.Start(Device, true, RingS, AudioSettings.outputSampleRate);
            if (recording == null) Debug.LogError("Nafir: there is no microphone", this);
            else if (recording.frequency != AudioSettings.outputSampleRate) Debug.LogError("Nafir: the microphone has not the game's sample rate", this);
            taken = 0;
        }

        void OnDisable()
        {
            if (recording != null) Microphone.End(Device);
            recording = null;
        }

        void Update()
        {
            if (recording == null) return;
            var frames = (Microphone.GetPosition(Device) - taken + recording.samples) % recording.samples;
            if (frames == 0) return;
            if (samples.Length != frames * recording.channels) samples = new float[frames * recording.channels]; // GetData fills all of it
            recording.GetData(samples, taken);
            taken = (taken + frames) % recording.samples;
            for (int i = 0; i < frames; i++) samples[i] = samples[i * recording.channels];
            emitter.Push(samples, frames);
        }
    }
}
