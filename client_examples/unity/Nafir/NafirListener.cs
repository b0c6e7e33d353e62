using UnityEngine;

namespace Nafir
{
    /// <summary>Another listener of a client's stream, who hears the same emitters from elsewhere: a second player at a split screen, or a
    /// spectator. Put it on that player's camera, with an AudioSource (Spatial Blend 2D) whose mixer group leads to that player's
    /// loudspeakers.</summary>
    [AddComponentMenu("Audio/Nafir Listener")]
    public sealed class NafirListener : MonoBehaviour
    {
        public NafirClient client;

        [Tooltip("One of GET /v1/hrtfs; empty for the server's default.")]
        public string head = "";

        string id;
        int times;
        NafirStream known; // the stream that has this listener
        volatile NafirEars ears;

        void OnDisable() => Follow(null);

        void Update()
        {
            var stream = client != null ? client.Stream : null;
            if (stream != known) Follow(stream);
            else stream?.MoveListener(id, client.PoseOf(transform));
        }

        void Follow(NafirStream stream)
        {
            known?.RemoveListener(id);
            known = stream;
            id = $"listener{GetInstanceID()}.{++times}"; // what is still to be said of the last one is not about this one
            ears = stream?.AddListener(id, client.PoseOf(transform), head == "" ? null : head);
        }

        void OnAudioFilterRead(float[] data, int channels) => ears?.AddTo(data, channels);
    }
}
