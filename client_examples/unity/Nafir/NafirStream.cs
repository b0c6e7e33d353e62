// A live stream that reconnects by itself, on threads of its own. It keeps the wanted state (poses, emitters) and sends it at first and
// after every reconnect. Without a type of Unity's.

using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.IO;
using System.Net.WebSockets;
using System.Text;
using System.Threading;
using System.Threading.Tasks;

namespace Nafir
{
    public enum NafirState { Connecting, Live, Waiting, Refused, Closed }

    public sealed class NafirStream : IDisposable
    {
        const int PoseIntervalMs = 12, AcknowledgeEvery = 4, BlocksAhead = 4, MostQueued = 4096;
        const int ConnectMs = 10000, SilenceMs = 4000; // a server that sends audio is never silent for so long
        const double LiveTargetS = 0.04;
        static readonly int[] RetryMs = { 250, 500, 1000, 2000, 4000 };

        readonly Uri url;
        readonly string scene, key;
        readonly int blockSize, bufferBlocks, outputRate;
        readonly double targetS;
        readonly CancellationTokenSource ending = new CancellationTokenSource();
        readonly object gate = new object();
        readonly Dictionary<string, Emitter> emitters = new Dictionary<string, Emitter>();
        readonly ConcurrentQueue<object> outgoing = new ConcurrentQueue<object>(); // string or byte[]
        readonly NafirBlock block = new NafirBlock();
        readonly float[] stereo = new float[2 * 1024];
        NafirPose listener;
        bool listenerMoved;
        bool wantsOutputRate = true, welcomed;
        uint poseId;
        NafirPlayback playback;
        volatile int state = (int)NafirState.Connecting;

        sealed class Emitter
        {
            public NafirSource Source;
            public bool Moved;
            public NafirPlayback Dry; // of a live one; from the reader of its samples to the stream's rate
            public uint Sequence;
            public bool Heard;
            public ulong StartClock;
            public ulong SentFrames;
        }

        /// <summary>`outputRate` is the sound card's. `targetS` is how much sound is held back against a network that stalls. `key` is an API
        /// key or token, if the server asks for one.</summary>
        public NafirStream(string url, string scene, int outputRate, NafirPose listener, double targetS = 0.06, string key = null, int blockSize = 256, int bufferBlocks = 8)
        {
            this.url = new Uri(url);
            this.scene = scene;
            this.key = key;
            this.outputRate = outputRate;
            this.listener = listener;
            this.targetS = targetS;
            this.blockSize = blockSize;
            this.bufferBlocks = bufferBlocks;
            Task.Run(Run);
        }

        public NafirState State => (NafirState)state;

        /// <summary>Why the stream was refused or last lost; null if it never was.</summary>
        public string Problem { get; private set; }

        /// <summary>The stream's sample rate; 0 before the first welcome.</summary>
        public int SampleRate { get; private set; }

        public int Underruns => Volatile.Read(ref playback)?.Underruns ?? 0;

        /// <summary>The newest poses that are in the sound received last: in its direct sound, and in all of it.</summary>
        public uint HeardPoseId { get; private set; }

        public uint HeardReverberationPoseId { get; private set; }

        /// <summary>Every text message of the server. Called on a thread of the stream.</summary>
        public event Action<Dictionary<string, object>> Received;

        public void SetListener(NafirPose pose)
        {
            lock (gate)
            {
                listener = pose;
                listenerMoved = true;
            }
        }

        /// <summary>Adds an emitter, or moves the one with this id. Another clip than before begins anew.</summary>
        public void SetEmitter(string id, NafirSource source)
        {
            lock (gate)
            {
                var isKnown = emitters.TryGetValue(id, out var emitter);
                if (isKnown && emitter.Source.Clip == source.Clip)
                {
                    if (emitter.Source.GainDb != source.GainDb) Say(NafirWire.SetGain(id, source.GainDb));
                    emitter.Source = source;
                    emitter.Moved = true;
                    return;
                }
                if (isKnown) Say(NafirWire.RemoveEmitter(id));
                emitters[id] = emitter = new Emitter { Source = source };
                Prepare(emitter);
                Say(NafirWire.AddEmitter(id, source));
            }
        }

        public void RemoveEmitter(string id)
        {
            lock (gate)
            {
                if (emitters.Remove(id)) Say(NafirWire.RemoveEmitter(id));
            }
        }

        /// <summary>Takes the next mono samples of a live emitter, at the output's rate. Returns false while it is not heard yet or if there
        /// is no room.</summary>
        public bool PushDry(string id, float[] samples, int frames)
        {
            NafirPlayback dry;
            lock (gate)
            {
                if (!emitters.TryGetValue(id, out var emitter) || !emitter.Heard) return false;
                dry = emitter.Dry;
            }
            return dry != null && dry.Push(samples, frames);
        }

        /// <summary>Adds what is heard to interleaved samples at the output's rate, on the audio thread. Both ears go to the first two
        /// channels; a single one has their mean.</summary>
        public void AddTo(float[] data, int channels)
        {
            var from = Volatile.Read(ref playback);
            if (from == null) return;
            int frames = data.Length / channels;
            for (int done = 0; done < frames;)
            {
                int some = Math.Min(frames - done, stereo.Length / 2);
                from.Read(stereo, some);
                for (int i = 0; i < some; i++)
                {
                    int to = (done + i) * channels;
                    float left = stereo[2 * i], right = stereo[2 * i + 1];
                    if (channels == 1)
                    {
                        data[to] += (left + right) / 2;
                        continue;
                    }
                    data[to] += left;
                    data[to + 1] += right;
                }
                done += some;
            }
        }

        public void Dispose()
        {
            state = (int)NafirState.Closed;
            ending.Cancel();
        }

        async Task Run()
        {
            for (int attempt = 0; !ending.IsCancellationRequested; attempt++)
            {
                int waitMs = 0;
                welcomed = false;
                try
                {
                    await Converse().ConfigureAwait(false);
                }
                catch (RefusalException refusal)
                {
                    Problem = refusal.Message;
                    waitMs = refusal.RetryAfterMs;
                    if (refusal.Code == "unsupported_sample_rate" && wantsOutputRate)
                    {
                        wantsOutputRate = false; // an older server renders at the scene's own rate alone
                        continue;
                    }
                    if (waitMs == 0)
                    {
                        state = (int)NafirState.Refused;
                        return;
                    }
                }
                catch (Exception lost) // whatever ended a connection, the next one may be better
                {
                    Problem = lost.Message;
                }
                if (ending.IsCancellationRequested) return;
                state = (int)NafirState.Waiting;
                if (welcomed) attempt = 0;
                if (waitMs == 0) waitMs = RetryMs[Math.Min(attempt, RetryMs.Length - 1)];
                await Task.WhenAny(Task.Delay(waitMs, ending.Token)).ConfigureAwait(false);
            }
        }

        sealed class RefusalException : Exception
        {
            public readonly string Code;
            public readonly int RetryAfterMs;

            public RefusalException(Dictionary<string, object> error) : base($"{error["code"]}: {error["message"]}")
            {
                Code = (string)error["code"];
                if (error.TryGetValue("retry_after_s", out var seconds) && seconds != null) RetryAfterMs = (int)(1000 * (double)seconds);
            }
        }

        /// <summary>One connection, until it ends.</summary>
        async Task Converse()
        {
            using (var socket = new ClientWebSocket())
            using (var leaving = CancellationTokenSource.CreateLinkedTokenSource(ending.Token))
            {
                leaving.CancelAfter(ConnectMs);
                if (!string.IsNullOrEmpty(key)) socket.Options.SetRequestHeader("Authorization", $"Bearer {key}");
                await socket.ConnectAsync(url, leaving.Token).ConfigureAwait(false);
                NafirPose start;
                lock (gate) start = listener;
                var hello = NafirWire.Hello(scene, wantsOutputRate ? outputRate : 0, blockSize, bufferBlocks, start);
                await Send(socket, hello, leaving.Token).ConfigureAwait(false);
                Task sending = null;
                try
                {
                    var message = new MemoryStream();
                    var part = new ArraySegment<byte>(new byte[16 * 1024]);
                    for (;;)
                    {
                        leaving.CancelAfter(SilenceMs);
                        var result = await socket.ReceiveAsync(part, leaving.Token).ConfigureAwait(false);
                        if (result.MessageType == WebSocketMessageType.Close)
                        {
                            Problem = $"closed with {(int?)result.CloseStatus}: {result.CloseStatusDescription}";
                            return;
                        }
                        message.Write(part.Array, 0, result.Count);
                        if (!result.EndOfMessage) continue;
                        if (result.MessageType == WebSocketMessageType.Binary)
                        {
                            Hear(message.GetBuffer(), (int)message.Length);
                        }
                        else if (Read(NafirJson.ParseObject(Encoding.UTF8.GetString(message.GetBuffer(), 0, (int)message.Length))))
                        {
                            sending = SendAll(socket, leaving.Token);
                        }
                        message.SetLength(0);
                    }
                }
                finally
                {
                    leaving.Cancel();
                    if (sending != null) await sending.ConfigureAwait(false);
                }
            }
        }

        /// <summary>Takes a text message. Returns whether it was the welcome. Throws RefusalException if it refuses the stream.</summary>
        bool Read(Dictionary<string, object> message)
        {
            var type = message["type"] as string;
            if (type == "error" && State != NafirState.Live) throw new RefusalException(message);
            if (type == "welcome") Begin((int)(double)message["sample_rate"]);
            if (type == "emitter_added")
            {
                lock (gate)
                {
                    if (emitters.TryGetValue((string)message["id"], out var emitter))
                    {
                        emitter.Heard = true;
                        emitter.StartClock = (ulong)(double)message["sample_clock"];
                    }
                }
            }
            Received?.Invoke(message);
            return type == "welcome";
        }

        void Begin(int sampleRate)
        {
            lock (gate)
            {
                welcomed = true;
                SampleRate = sampleRate;
                while (outgoing.TryDequeue(out _)) { } // of the last connection
                poseId = 0;
                listenerMoved = true;
                Volatile.Write(ref playback, new NafirPlayback(2, sampleRate, outputRate, targetS));
                state = (int)NafirState.Live;
                foreach (var pair in emitters)
                {
                    Prepare(pair.Value);
                    Say(NafirWire.AddEmitter(pair.Key, pair.Value.Source));
                }
            }
        }

        void Prepare(Emitter emitter)
        {
            emitter.Heard = false;
            emitter.Sequence = 0;
            emitter.SentFrames = 0;
            if (emitter.Source.Clip == null && SampleRate > 0) emitter.Dry = new NafirPlayback(1, outputRate, SampleRate, LiveTargetS);
        }

        void Hear(byte[] data, int size)
        {
            if (!NafirWire.TryParse(data, size, block)) return;
            if (block.Channels == 2) playback?.Push(block.Samples, block.Frames);
            HeardPoseId = block.PoseId;
            HeardReverberationPoseId = block.ReverberationPoseId;
            lock (gate)
            {
                if (block.Sequence % AcknowledgeEvery == AcknowledgeEvery - 1) Say(NafirWire.Acknowledge(block.Sequence));
                foreach (var pair in emitters)
                {
                    var emitter = pair.Value;
                    if (emitter.Source.Clip != null || !emitter.Heard || block.SampleClock < emitter.StartClock) continue;
                    // The server's clock counts: as many samples as it has rendered, and a few blocks ahead.
                    var due = block.SampleClock - emitter.StartClock + (ulong)((1 + BlocksAhead) * block.Frames);
                    for (; emitter.SentFrames < due; emitter.SentFrames += (ulong)block.Frames)
                    {
                        var dry = new float[block.Frames];
                        emitter.Dry.Read(dry, dry.Length);
                        Say(NafirWire.DryBlock(pair.Key, emitter.Sequence++, dry, dry.Length));
                    }
                }
            }
        }

        void Say(object message)
        {
            if (State == NafirState.Live && outgoing.Count < MostQueued) outgoing.Enqueue(message);
        }

        /// <summary>Sends what is to be said, and of the poses only the newest, until the connection ends.</summary>
        async Task SendAll(ClientWebSocket socket, CancellationToken end)
        {
            object message; // declared here, since Mono's compiler fails at `out var` in what is asynchronous
            try
            {
                while (!end.IsCancellationRequested)
                {
                    lock (gate) AddPoses();
                    while (outgoing.TryDequeue(out message)) await Send(socket, message, end).ConfigureAwait(false);
                    await Task.Delay(PoseIntervalMs, end).ConfigureAwait(false);
                }
            }
            catch (Exception) when (end.IsCancellationRequested || socket.State != WebSocketState.Open)
            {
                socket.Abort(); // ends the reading too, which says why
            }
        }

        void AddPoses()
        {
            foreach (var pair in emitters)
            {
                if (!pair.Value.Moved) continue;
                pair.Value.Moved = false;
                Say(NafirWire.MoveEmitter(pair.Key, ++poseId, pair.Value.Source.Pose));
            }
            if (!listenerMoved) return;
            listenerMoved = false;
            Say(NafirWire.Listener(++poseId, listener));
        }

        static Task Send(ClientWebSocket socket, object message, CancellationToken end)
        {
            var isText = message is string;
            var bytes = isText ? Encoding.UTF8.GetBytes((string)message) : (byte[])message;
            var type = isText ? WebSocketMessageType.Text : WebSocketMessageType.Binary;
            return socket.SendAsync(new ArraySegment<byte>(bytes), type, true, end);
        }
    }
}
