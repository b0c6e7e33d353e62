using UnityEngine;

namespace Nafir
{
    /// <summary>Hears a scene of a Nafir server. Put it where the AudioListener is: on the camera. What the listener hears there is added to
    /// the sound of the game.</summary>
    [AddComponentMenu("Audio/Nafir Client")]
    public sealed class NafirClient : MonoBehaviour
    {
        [Tooltip("The server's stream.")]
        public string url = "ws://127.0.0.1:8000/v1/stream";

        [Tooltip("One of GET /v1/scenes.")]
        public string scene = "apartment";

        [Tooltip("An API key or token, if the server asks for one.")]
        public string key = "";

        [Tooltip("Where the scene's origin is in the game; empty if at the world's.")]
        public Transform origin;

        [Tooltip("Seconds of sound that are held back against a network that stalls.")]
        public float buffer = 0.06f;

        NafirState told = NafirState.Connecting;
        volatile NafirStream stream;

        /// <summary>The stream; null while the component is disabled.</summary>
        public NafirStream Stream => stream;

        void OnEnable()
        {
            told = NafirState.Connecting;
            stream = new NafirStream(url, scene, AudioSettings.outputSampleRate, PoseOf(transform), buffer, key);
        }

        void OnDisable()
        {
            var ending = stream;
            stream = null;
            ending.Dispose();
        }

        void Update()
        {
            stream.SetListener(PoseOf(transform));
            if (stream.State == told) return;
            told = stream.State;
            if (told == NafirState.Refused) Debug.LogError($"Nafir: {stream.Problem}", this);
            if (told == NafirState.Waiting) Debug.LogWarning($"Nafir: {stream.Problem}. Connecting again.", this);
        }

        void OnAudioFilterRead(float[] data, int channels) => stream?.AddTo(data, channels);

        /// <summary>The pose of a transform in the axes of the server's scene.</summary>
        public NafirPose PoseOf(Transform of)
        {
            var position = of.position;
            var rotation = of.rotation;
            if (origin != null)
            {
                var back = Quaternion.Inverse(origin.rotation);
                position = back * (position - origin.position);
                rotation = back * rotation;
            }
            return NafirPose.FromUnity(
                new NafirVector(position.x, position.y, position.z),
                new NafirQuaternion(rotation.x, rotation.y, rotation.z, rotation.w));
        }
    }
}
