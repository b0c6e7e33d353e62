using System;
using System.Collections.Concurrent;
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

        [Tooltip("Seconds for which a server that is gone is tried again.")]
        public float giveUpAfter = 300;

        [Tooltip("How many listeners there are going to be, with this one: the server keeps room for them.")]
        public int listeners = 1;

        readonly ConcurrentQueue<Action> news = new ConcurrentQueue<Action>(); // of the stream's threads, for the game's
        volatile NafirStream stream;

        /// <summary>The stream; null while the component is disabled.</summary>
        public NafirStream Stream => stream;

        /// <summary>The stream is live, was lost and is being tried again (`Waiting`), or is over (`Refused`, `Lost`). `Stream.Problem` says
        /// why. Events are raised in `Update`.</summary>
        public event Action<NafirState> StateChanged;

        /// <summary>The clip of the emitter with this id is over, with its reverberation.</summary>
        public event Action<string> EmitterEnded;

        void OnEnable()
        {
            var opened = new NafirStream(url, scene, AudioSettings.outputSampleRate, PoseOf(transform), buffer, key, giveUpAfterS: giveUpAfter, listeners: listeners);
            opened.StateChanged += state => news.Enqueue(() => Tell(state, opened.Problem));
            opened.EmitterEnded += id => news.Enqueue(() => EmitterEnded?.Invoke(id));
            opened.EmitterRefused += (id, problem) => news.Enqueue(() => Debug.LogWarning($"Nafir: emitter {id}: {problem}", this));
            opened.ListenerRefused += (id, problem) => news.Enqueue(() => Debug.LogWarning($"Nafir: listener {id}: {problem}", this));
            stream = opened;
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
            Action told; // declared here for Mono's compiler
            while (news.TryDequeue(out told)) told();
        }

        void Tell(NafirState state, string problem)
        {
            if (state == NafirState.Refused || state == NafirState.Lost) Debug.LogError($"Nafir: {problem}", this);
            if (state == NafirState.Waiting) Debug.LogWarning($"Nafir: {problem}. Connecting again.", this);
            StateChanged?.Invoke(state);
        }

        void OnAudioFilterRead(float[] data, int channels) => stream?.AddTo(data, channels);

        /// <summary>Plays a clip of the server once at a transform's present place. Returns the id of its emitter.</summary>
        public string PlayOneShot(string clip, Transform at, float gainDb = 0) => stream?.PlayOneShot(clip, PoseOf(at), gainDb);

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
