// Messages of /v1/stream, protocol 3: binary ones are little endian, text ones are JSON. Without a type of Unity's.

using System;
using System.Globalization;
using System.Text;

namespace Nafir
{
    /// <summary>A block of rendered audio. `Samples` are interleaved.</summary>
    public sealed class NafirBlock
    {
        /// <summary>A bit of `Flags`: the server had not rendered the block in time.</summary>
        public const byte Late = 2;

        public uint Sequence, PoseId, ReverberationPoseId;
        public ulong SampleClock;
        public byte Flags, Listener; // the number of who hears it: 0 for the first
        public int Channels, Frames;
        public float[] Samples = new float[0];
    }

    /// <summary>What an emitter plays, and how. Without a clip it plays the samples that the client sends.</summary>
    public sealed class NafirSource
    {
        public string Clip;
        public NafirPose Pose;
        public float GainDb;
        public bool Loop = true;

        /// <summary>The clocks of the stream at which the clip begins and from which on it fades out; null for at once, and never.</summary>
        public ulong? StartAt, StopAt;

        /// <summary>Where in the clip to begin, and what a loop repeats; an end of 0 is the clip's.</summary>
        public float OffsetS, LoopStartS, LoopEndS;

        /// <summary>Whether the emitter is removed once the clip and its reverberation are over.</summary>
        public bool RemoveWhenEnded;

        /// <summary>How long samples of a live emitter wait at the server; 0 for its own choice.</summary>
        public float JitterMs;
    }

    public static class NafirWire
    {
        public const int Protocol = 3;
        const int AudioHeader = 28, DryHeader = 12;
        const float FullScale = 32767;

        /// <summary>Reads a block of 16-bit samples into `block`, whose array is kept where it is long enough. Returns false for another
        /// kind of message, which a client ignores, and for a damaged one.</summary>
        public static bool TryParse(byte[] data, int size, NafirBlock block)
        {
            if (size < AudioHeader || data[0] != 1) return false;
            int channels = data[2];
            long frames = UInt(data, 24);
            if (channels == 0 || size - AudioHeader != 2 * channels * frames) return false;
            block.Flags = data[1];
            block.Channels = channels;
            block.Listener = data[3];
            block.Sequence = UInt(data, 4);
            block.SampleClock = UInt(data, 8) | (ulong)UInt(data, 12) << 32;
            block.PoseId = UInt(data, 16);
            block.ReverberationPoseId = UInt(data, 20);
            block.Frames = (int)frames;
            int count = channels * block.Frames;
            if (block.Samples.Length < count) block.Samples = new float[count];
            for (int i = 0, from = AudioHeader; i < count; i++, from += 2) block.Samples[i] = (short)(data[from] | data[from + 1] << 8) / FullScale;
            return true;
        }

        /// <summary>A listener's pose. `poseId` rises over all poses of the stream, of listeners and emitters. `number` is that of a listener
        /// beside the first.</summary>
        public static byte[] Listener(uint poseId, NafirPose pose, byte number = 0)
        {
            var data = new byte[36];
            data[0] = 2;
            data[1] = number;
            Put(data, 4, poseId);
            var numbers = Numbers(pose);
            for (int i = 0; i < numbers.Length; i++) Put(data, 8 + 4 * i, BitConverter.ToUInt32(BitConverter.GetBytes(numbers[i]), 0));
            return data;
        }

        /// <summary>The next mono samples of a live emitter. `sequence` rises from block to block.</summary>
        public static byte[] DryBlock(string id, uint sequence, float[] samples, int frames)
        {
            var name = Encoding.UTF8.GetBytes(id);
            int start = DryHeader + (name.Length + 3) / 4 * 4;
            var data = new byte[start + 2 * frames];
            data[0] = 3;
            data[1] = 1;
            data[2] = (byte)name.Length;
            data[3] = (byte)(name.Length >> 8);
            Put(data, 4, sequence);
            Put(data, 8, (uint)frames);
            name.CopyTo(data, DryHeader);
            for (int i = 0; i < frames; i++)
            {
                var sample = (short)Math.Round(Math.Max(-1, Math.Min(1, samples[i])) * FullScale);
                data[start + 2 * i] = (byte)sample;
                data[start + 2 * i + 1] = (byte)(sample >> 8);
            }
            return data;
        }

        /// <summary>The first message. A `sampleRate` of 0 takes the scene's own, a `level` of null is the server's choice. `listeners` is how
        /// many the stream is about to have.</summary>
        public static string Hello(string scene, int sampleRate, int blockSize, int bufferBlocks, NafirPose listener, string level = null, int listeners = 1)
        {
            var several = listeners > 1 ? $",\"listeners\":{listeners}" : "";
            var rate = sampleRate > 0 ? $",\"sample_rate\":{sampleRate}" : "";
            var quality = level != null ? $",\"level\":{NafirJson.Quote(level)}" : "";
            return $"{{\"type\":\"hello\",\"protocol\":{Protocol},\"scene\":{NafirJson.Quote(scene)},\"block_size\":{blockSize},\"encoding\":\"s16\","
                + $"\"buffer_blocks\":{bufferBlocks},\"snapshots\":true,\"listener\":{{{Text(listener)}}}{rate}{quality}{several}}}";
        }

        /// <summary>The first message of a connection that goes on with a lost stream. `token` is that of the last welcome, `snapshot` the newest
        /// one; either may be null. `last` is the last block that arrived, if one has.</summary>
        public static string Resume(string token, string snapshot, NafirBlock last)
        {
            var text = $"{{\"type\":\"resume\",\"protocol\":{Protocol}";
            if (token != null) text += $",\"token\":{NafirJson.Quote(token)}";
            if (snapshot != null) text += $",\"snapshot\":{NafirJson.Quote(snapshot)}";
            if (last != null) text += $",\"sequence\":{last.Sequence},\"sample_clock\":{last.SampleClock}";
            return text + "}";
        }

        /// <summary>Clocks of the source are those of the stream, which is `clockOffset` samples ahead of the server's.</summary>
        public static string AddEmitter(string id, NafirSource source, ulong clockOffset = 0)
        {
            var text = $"{{\"type\":\"add_emitter\",\"id\":{NafirJson.Quote(id)},\"gain_db\":{Text(source.GainDb)},{Text(source.Pose)}";
            if (source.Clip == null) return text + ",\"live\":true" + (source.JitterMs > 0 ? $",\"jitter_ms\":{Text(source.JitterMs)}}}" : "}");
            text += $",\"clip\":{NafirJson.Quote(source.Clip)},\"loop\":{Text(source.Loop)}";
            if (source.StartAt != null) text += $",\"start_at\":{Server(source.StartAt.Value, clockOffset)}";
            if (source.StopAt != null) text += $",\"stop_at\":{Server(source.StopAt.Value, clockOffset)}";
            if (source.OffsetS > 0) text += $",\"offset_s\":{Text(source.OffsetS)}";
            if (source.Loop && source.LoopStartS > 0) text += $",\"loop_start_s\":{Text(source.LoopStartS)}";
            if (source.Loop && source.LoopEndS > 0) text += $",\"loop_end_s\":{Text(source.LoopEndS)}";
            if (source.RemoveWhenEnded) text += ",\"remove_when_ended\":true";
            return text + "}";
        }

        public static string MoveEmitter(string id, uint poseId, NafirPose pose) =>
            $"{{\"type\":\"move_emitter\",\"id\":{NafirJson.Quote(id)},\"pose_id\":{poseId},{Text(pose)}}}";

        public static string SetGain(string id, float gainDb, float rampS = 0) =>
            $"{{\"type\":\"set_gain\",\"id\":{NafirJson.Quote(id)},\"gain_db\":{Text(gainDb)},\"ramp_s\":{Text(rampS)}}}";

        /// <summary>Opens a door of the scene so far, from 0, shut, to 1.</summary>
        public static string SetDoor(string door, float openness) =>
            $"{{\"type\":\"set_door\",\"door\":{NafirJson.Quote(door)},\"openness\":{Text(openness)}}}";

        /// <summary>Lets a clip fade out from a clock on, or at once (null).</summary>
        public static string StopEmitter(string id, ulong? stopAt, float fadeS, ulong clockOffset = 0)
        {
            var at = stopAt != null ? $",\"stop_at\":{Server(stopAt.Value, clockOffset)}" : "";
            return $"{{\"type\":\"stop_emitter\",\"id\":{NafirJson.Quote(id)},\"fade_s\":{Text(fadeS)}{at}}}";
        }

        public static string RemoveEmitter(string id) => $"{{\"type\":\"remove_emitter\",\"id\":{NafirJson.Quote(id)}}}";

        /// <summary>Adds a listener beside the first. A `head` of null is the server's default.</summary>
        public static string AddListener(string id, NafirPose pose, string head)
        {
            var hrtf = head != null ? $",\"hrtf\":{NafirJson.Quote(head)}" : "";
            return $"{{\"type\":\"add_listener\",\"id\":{NafirJson.Quote(id)},{Text(pose)}{hrtf}}}";
        }

        public static string RemoveListener(string id) => $"{{\"type\":\"remove_listener\",\"id\":{NafirJson.Quote(id)}}}";

        public static string SetLevel(string level) => $"{{\"type\":\"set_level\",\"level\":{NafirJson.Quote(level)}}}";

        public static string Ping(uint id) => $"{{\"type\":\"ping\",\"id\":{id}}}";

        /// <summary>Every block up to `sequence` has arrived, of the listener with this id or of the first (null). Without it the server soon
        /// stops sending.</summary>
        public static string Acknowledge(uint sequence, string listener = null)
        {
            var whose = listener != null ? $",\"listener\":{NafirJson.Quote(listener)}" : "";
            return $"{{\"type\":\"acknowledge\",\"sequence\":{sequence}{whose}}}";
        }

        static float[] Numbers(NafirPose pose)
        {
            var p = pose.Position;
            var q = pose.Orientation;
            return new[] { p.X, p.Y, p.Z, q.X, q.Y, q.Z, q.W };
        }

        static string Text(NafirPose pose)
        {
            var texts = Array.ConvertAll(Numbers(pose), Text);
            return $"\"position\":[{string.Join(",", texts, 0, 3)}],\"orientation\":[{string.Join(",", texts, 3, 4)}]";
        }

        static ulong Server(ulong clock, ulong offset) => clock - Math.Min(clock, offset);

        static string Text(bool value) => value ? "true" : "false";

        // With a point whatever the language of the system.
        static string Text(float value) => value.ToString("R", CultureInfo.InvariantCulture);

        static uint UInt(byte[] data, int at) => data[at] | (uint)data[at + 1] << 8 | (uint)data[at + 2] << 16 | (uint)data[at + 3] << 24;

        static void Put(byte[] data, int at, uint value)
        {
            for (int i = 0; i < 4; i++) data[at + i] = (byte)(value >> (8 * i));
        }
    }
}
