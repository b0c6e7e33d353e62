// A live stream that reconnects by itself, on threads of its own. A server that has kept the stream goes on with it, and is sent what it had
// not got yet. Else the stream begins anew with what is wanted (poses, emitters, level). Without a type of Unity's.

using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.Diagnostics;
using System.IO;
using System.Net.WebSockets;
using System.Text;
using System.Threading;
using System.Threading.Tasks;

namespace Nafir
{
    /// <summary>`Waiting` is a stream whose connection is lost and is going to be tried again. `Refused` and `Lost` are final: the server does
    /// not want the stream, or could not be reached for too long.</summary>
    public enum NafirState { Connecting, Live, Waiting, Refused, Lost, Closed }

    public sealed class NafirStream : IDisposable
    {
        const int PoseIntervalMs = 12, AcknowledgeEvery = 4, BlocksAhead = 4, MostQueued = 4096;
        const int ConnectMs = 10000, SilenceMs = 4000; // a server that sends audio is never silent for so long
        const int PingMs = 1000, GoodbyeMs = 250;
        const double LiveTargetS = 0.04;
        static readonly int[] RetryMs = { 250, 500, 1000, 2000, 4000, 8000, 15000 };

        static readonly HashSet<object> LastWords = new HashSet<object> { "taken_over", "key_expired", "key_revoked", "stalled", "reads_too_slowly" };

        readonly Uri url;
        readonly string scene, key;
        readonly int blockSize, bufferBlocks, outputRate;
        readonly double targetS, giveUpAfterS;
        readonly CancellationTokenSource ending = new CancellationTokenSource();
        readonly Task running;
        readonly object gate = new object();
        readonly Dictionary<string, float> doors = new Dictionary<string, float>(); // those that the game has moved
        readonly HashSet<string> doorsMoved = new HashSet<string>(); // of them, while there was no connection
        readonly Dictionary<string, Emitter> emitters = new Dictionary<string, Emitter>();
        readonly ConcurrentQueue<object> outgoing = new ConcurrentQueue<object>(); // string or byte[]
        readonly NafirOrders orders = new NafirOrders();
        readonly NafirBlock block = new NafirBlock();
        readonly float[] stereo = new float[2 * 1024];
        readonly Stopwatch sinceLost = Stopwatch.StartNew(), sinceBlock = Stopwatch.StartNew(), sincePing = Stopwatch.StartNew();
        NafirStatistics counts;
        NafirPose listener;
        bool listenerMoved;
        bool wantsOutputRate = true, welcomed, everWelcomed;
        string wantedLevel; // null is the server's choice
        string token, snapshot; // with which the stream is resumed
        uint poseId, pingId;
        int shots;
        bool hasBlock; // since the stream began; it is in `block`
        ulong nextClock, clockOffset; // of the server's; what is added to it
        NafirPlayback playback;
        volatile int state = (int)NafirState.Connecting;

        sealed class Emitter
        {
            public NafirSource Source;
            public bool Moved, Stopped;
            public long Number; // of the order that adds it
            public NafirPlayback Dry; // of a live one; from the reader of its samples to the stream's rate
            public uint Sequence;
            public bool Heard;
            public ulong StartClock; // of the server
            public ulong SentFrames;
            public Stopwatch Refused; // since when
            public long AskAgainMs; // after that; 0 for never

            /// <summary>Whether its clip has an end, so that a new stream does not begin it again.</summary>
            public bool PlaysOnce => Source.Clip != null && (!Source.Loop || Stopped);
        }

        /// <summary>`outputRate` is the sound card's. `targetS` is how much sound is held back against a network that stalls. `key` is an API
        /// key or token, if the server asks for one. A server that is gone is tried again for `giveUpAfterS` seconds.</summary>
        public NafirStream(string url, string scene, int outputRate, NafirPose listener, double targetS = 0.06, string key = null, int blockSize = 256, int bufferBlocks = 8, double giveUpAfterS = 300)
        {
            this.url = new Uri(url);
            this.scene = scene;
            this.key = key;
            this.outputRate = outputRate;
            this.listener = listener;
            this.targetS = targetS;
            this.blockSize = blockSize;
            this.bufferBlocks = bufferBlocks;
            this.giveUpAfterS = giveUpAfterS;
            running = Task.Run(Run);
        }

        public NafirState State => (NafirState)state;

        /// <summary>Why the stream was refused or last lost; null if it never was.</summary>
        public string Problem { get; private set; }

        /// <summary>The stream's sample rate; 0 before the first welcome.</summary>
        public int SampleRate { get; private set; }

        /// <summary>The quality level that is heard; null before the first welcome.</summary>
        public string Level { get; private set; }

        /// <summary>The clock of the sample after the newest block, which goes on over lost connections.</summary>
        public ulong SampleClock { get; private set; }

        public int Underruns => Volatile.Read(ref playback)?.Underruns ?? 0;

        /// <summary>The newest poses that are in the sound received last: in its direct sound, and in all of it.</summary>
        public uint HeardPoseId { get; private set; }

        public uint HeardReverberationPoseId { get; private set; }

        public NafirStatistics Statistics
        {
            get
            {
                lock (gate)
                {
                    var found = counts;
                    found.Underruns = Underruns;
                    found.WaitingS = playback?.WaitingS ?? 0;
                    return found;
                }
            }
        }

        /// <summary>Every text message of the server. Events are raised on threads of the stream.</summary>
        public event Action<Dictionary<string, object>> Received;

        /// <summary>The stream is live, was lost (`Waiting`, with the reason in `Problem`) or is over.</summary>
        public event Action<NafirState> StateChanged;

        /// <summary>The clip of an emitter is over, with its reverberation, or cannot be played on after a loss.</summary>
        public event Action<string> EmitterEnded;

        /// <summary>An emitter could not be added, and why.</summary>
        public event Action<string, string> EmitterRefused;

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
                    if (emitter.Source.GainDb != source.GainDb) Order(NafirWire.SetGain(id, source.GainDb));
                    emitter.Source = source;
                    emitter.Moved = true;
                    return;
                }
                if (isKnown) Order(NafirWire.RemoveEmitter(id));
                emitters[id] = emitter = new Emitter { Source = source };
                Prepare(emitter);
                Add(id, emitter);
            }
        }

        /// <summary>As <see cref="SetEmitter"/>, for an emitter that is there. One that has ended stays away.</summary>
        public void ChangeEmitter(string id, NafirSource source)
        {
            lock (gate)
            {
                if (emitters.ContainsKey(id)) SetEmitter(id, source);
            }
        }

        /// <summary>Plays a clip once at a place, as soon as it can be heard or from a clock on. Returns the id of its emitter, which is removed
        /// once the clip and its reverberation are over.</summary>
        public string PlayOneShot(string clip, NafirPose pose, float gainDb = 0, ulong? startAt = null)
        {
            var id = $"shot{Interlocked.Increment(ref shots)}";
            SetEmitter(id, new NafirSource { Clip = clip, Pose = pose, GainDb = gainDb, Loop = false, StartAt = startAt, RemoveWhenEnded = true });
            return id;
        }

        /// <summary>Changes the gain of an emitter over `rampS` seconds, linearly in decibels.</summary>
        public void SetGain(string id, float gainDb, float rampS = 0)
        {
            lock (gate)
            {
                if (!emitters.TryGetValue(id, out var emitter)) return;
                emitter.Source.GainDb = gainDb;
                Order(NafirWire.SetGain(id, gainDb, rampS));
            }
        }

        /// <summary>Opens a door of the scene so far, from 0, shut, to 1. Call it with each frame while a door swings.</summary>
        public void SetDoor(string door, float openness)
        {
            lock (gate)
            {
                if (doors.TryGetValue(door, out var before) && before == openness) return;
                doors[door] = openness;
                if (welcomed) Order(NafirWire.SetDoor(door, openness));
                else doorsMoved.Add(door);
            }
        }

        /// <summary>Lets the clip of an emitter fade out from a clock on, or at once. <see cref="EmitterEnded"/> follows.</summary>
        public void StopEmitter(string id, ulong? stopAt = null, float fadeS = 0.01f)
        {
            lock (gate)
            {
                if (!emitters.TryGetValue(id, out var emitter) || emitter.Source.Clip == null) return;
                emitter.Stopped = true;
                Order(NafirWire.StopEmitter(id, stopAt, fadeS, clockOffset));
            }
        }

        public void RemoveEmitter(string id)
        {
            lock (gate)
            {
                if (emitters.Remove(id)) Order(NafirWire.RemoveEmitter(id));
            }
        }

        /// <summary>Chooses a quality level, or `auto`.</summary>
        public void SetLevel(string level)
        {
            lock (gate)
            {
                wantedLevel = level;
                Order(NafirWire.SetLevel(level));
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

        /// <summary>Leaves for good: the server keeps nothing. Waits for the goodbye, a quarter of a second at most.</summary>
        public void Dispose()
        {
            bool wasLive;
            lock (gate)
            {
                wasLive = State == NafirState.Live;
                state = (int)NafirState.Closed; // so that the sender says goodbye
            }
            if (wasLive) running.Wait(GoodbyeMs);
            try
            {
                ending.Cancel();
            }
            catch (AggregateException)
            {
                // A socket that closes at the same moment may refuse to be aborted.
            }
        }

        async Task Run()
        {
            var luck = new Random();
            for (int attempt = 0; !ending.IsCancellationRequested; attempt++)
            {
                int waitMs = 0;
                bool mayTryAgain = true;
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
                    if (refusal.Code == "unknown_resume_token" && Forget()) continue; // begins anew
                    mayTryAgain = waitMs > 0;
                }
                catch (OperationCanceledException)
                {
                    Problem = "the server is silent";
                }
                catch (Exception lost) // whatever ended a connection, the next one may be better
                {
                    Problem = lost.Message;
                }
                if (State == NafirState.Closed) return;
                if (welcomed)
                {
                    attempt = 0;
                    sinceLost.Restart();
                    lock (gate) welcomed = false;
                }
                if (waitMs == 0) waitMs = (int)(RetryMs[Math.Min(attempt, RetryMs.Length - 1)] * (0.5 + 0.5 * luck.NextDouble()));
                if (!mayTryAgain || sinceLost.Elapsed.TotalSeconds + waitMs / 1000.0 > giveUpAfterS)
                {
                    Become(mayTryAgain ? NafirState.Lost : NafirState.Refused);
                    return;
                }
                Become(NafirState.Waiting);
                await Task.WhenAny(Task.Delay(waitMs, ending.Token)).ConfigureAwait(false);
            }
        }

        void Become(NafirState next)
        {
            lock (gate)
            {
                if (State == NafirState.Closed || State == next) return;
                state = (int)next;
            }
            StateChanged?.Invoke(next);
        }

        /// <summary>The server refuses the stream. It may be asked again if it says when.</summary>
        sealed class RefusalException : Exception
        {
            public readonly string Code;
            public readonly int RetryAfterMs;

            public RefusalException(string code, string message) : base($"{code}: {message}") => Code = code;

            public RefusalException(Dictionary<string, object> error) : this((string)error["code"], (string)error["message"]) => RetryAfterMs = AdviceMs(error);
        }

        static int AdviceMs(Dictionary<string, object> error) =>
            error.TryGetValue("retry_after_s", out var seconds) && seconds != null ? (int)(1000 * (double)seconds) : 0;

        /// <summary>One connection, until it ends. Throws RefusalException if another is not to follow, or not at once.</summary>
        async Task Converse()
        {
            using (var socket = new ClientWebSocket())
            using (var leaving = CancellationTokenSource.CreateLinkedTokenSource(ending.Token))
            {
                leaving.CancelAfter(ConnectMs);
                if (!string.IsNullOrEmpty(key)) socket.Options.SetRequestHeader("Authorization", $"Bearer {key}");
                await socket.ConnectAsync(url, leaving.Token).ConfigureAwait(false);
                await Send(socket, FirstMessage(), leaving.Token).ConfigureAwait(false);
                Task sending = null;
                Dictionary<string, object> lastError = null; // of the whole stream
                object about; // declared here, since Mono's compiler fails at `out var` in what is asynchronous
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
                            throw Ended((int?)result.CloseStatus ?? 1005, result.CloseStatusDescription, lastError);
                        }
                        message.Write(part.Array, 0, result.Count);
                        if (!result.EndOfMessage) continue;
                        if (result.MessageType == WebSocketMessageType.Binary)
                        {
                            Hear(message.GetBuffer(), (int)message.Length);
                        }
                        else
                        {
                            var text = NafirJson.ParseObject(Encoding.UTF8.GetString(message.GetBuffer(), 0, (int)message.Length));
                            if (text["type"] as string == "error" && !(text.TryGetValue("emitter", out about) && about != null)) lastError = text;
                            if (Read(text)) sending = SendAll(socket, leaving.Token);
                        }
                        message.SetLength(0);
                    }
                }
                // Some systems do not tell how a connection was closed, but the server's last words were about that.
                catch (Exception end) when (!(end is RefusalException) && lastError != null && (AdviceMs(lastError) > 0 || LastWords.Contains(lastError["code"])))
                {
                    throw new RefusalException(lastError);
                }
                finally
                {
                    leaving.Cancel();
                    if (sending != null) await sending.ConfigureAwait(false);
                }
            }
        }

        /// <summary>What a close frame means. After some codes a new connection would do no better, unless the server has said when.</summary>
        static Exception Ended(int code, string reason, Dictionary<string, object> error)
        {
            var isFinal = code >= 1000 && code <= 1003 && code != 1001 || code >= 1007 && code <= 1010 || code >= 4400 && code < 4500;
            if (error != null && (isFinal || AdviceMs(error) > 0)) return new RefusalException(error);
            if (isFinal) return new RefusalException(code.ToString(), reason);
            return new IOException($"closed with {code}: {reason}");
        }

        string FirstMessage()
        {
            lock (gate)
            {
                if (CanResume) return NafirWire.Resume(token, snapshot, hasBlock ? block : null);
                return NafirWire.Hello(scene, wantsOutputRate ? outputRate : 0, blockSize, bufferBlocks, listener, wantedLevel);
            }
        }

        bool CanResume => token != null || snapshot != null;

        /// <summary>Lets go of the stream that there was, so that the next connection begins anew. Returns whether there was one.</summary>
        bool Forget()
        {
            lock (gate)
            {
                var had = CanResume;
                token = snapshot = null;
                orders.Clear();
                return had;
            }
        }

        /// <summary>Takes a text message. Returns whether it was the welcome. Throws RefusalException if it refuses the stream.</summary>
        bool Read(Dictionary<string, object> message)
        {
            var type = message["type"] as string;
            string ended = null, refused = null;
            if (type == "error" && !welcomed) throw new RefusalException(message);
            if (type == "welcome") Welcome(message);
            lock (gate)
            {
                Emitter emitter = null;
                var id = message.TryGetValue(type == "error" ? "emitter" : "id", out var name) ? name as string : null;
                if (id != null) emitters.TryGetValue(id, out emitter);
                if (type == "snapshot")
                {
                    snapshot = (string)message["snapshot"];
                    orders.Forget((long)(double)message["handled"]);
                }
                else if (type == "level_changed") Level = (string)message["level"];
                else if (type == "pong" && (double)message["id"] == pingId) counts.RoundTripS = sincePing.Elapsed.TotalSeconds;
                else if (emitter == null) { }
                else if (type == "emitter_added") Open(emitter, (ulong)(double)message["sample_clock"]);
                else if (type == "emitter_ended")
                {
                    if ((bool)message["removed"]) emitters.Remove(id);
                    ended = id;
                }
                else if (type == "error" && !emitter.Heard)
                {
                    emitter.Refused = Stopwatch.StartNew();
                    emitter.AskAgainMs = AdviceMs(message);
                    refused = id;
                }
                else if (type == "error" && (string)message["code"] == "unknown_emitter" && emitter.PlaysOnce)
                {
                    emitters.Remove(id); // its end was said just before the connection was lost
                    ended = id;
                }
            }
            if (type == "error") Problem = $"{message["code"]}: {message["message"]}";
            Received?.Invoke(message);
            if (ended != null) EmitterEnded?.Invoke(ended);
            if (refused != null) EmitterRefused?.Invoke(refused, Problem);
            return type == "welcome";
        }

        void Welcome(Dictionary<string, object> message)
        {
            var over = new List<string>();
            lock (gate)
            {
                welcomed = true;
                int sampleRate = (int)(double)message["sample_rate"];
                token = message.TryGetValue("resume_token", out var given) ? given as string : null;
                Level = (string)message["level"];
                while (outgoing.TryDequeue(out _)) { } // of the last connection
                listenerMoved = true;
                if (playback == null || SampleRate != sampleRate) Volatile.Write(ref playback, new NafirPlayback(2, sampleRate, outputRate, targetS));
                SampleRate = sampleRate;
                if (everWelcomed) counts.Reconnections++;
                everWelcomed = true;
                if (message.TryGetValue("resumed", out var resumed) && resumed != null) GoOn((Dictionary<string, object>)resumed);
                else Begin(over);
            }
            foreach (var id in over) EmitterEnded?.Invoke(id);
            Become(NafirState.Live);
        }

        /// <summary>The server has the stream still: it gets what it has not handled, and where everything is now.</summary>
        void GoOn(Dictionary<string, object> resumed)
        {
            var handled = (long)(double)resumed["handled"];
            var clock = (ulong)(double)resumed["sample_clock"];
            var again = orders.After(handled);
            if (again == null)
            {
                Forget();
                throw new IOException("too much was said while the connection was lost; the stream begins anew");
            }
            counts.Resumptions++;
            foreach (var each in again) outgoing.Enqueue(each);
            foreach (var door in doorsMoved) Order(NafirWire.SetDoor(door, doors[door]));
            doorsMoved.Clear();
            poseId = Math.Max(poseId, (uint)(double)resumed["pose_id"]);
            foreach (var emitter in emitters.Values)
            {
                emitter.Moved = true;
                // What was added is there, and that it is heard may have been said just before the connection was lost.
                if (emitter.Heard || emitter.Number <= handled) Open(emitter, clock);
            }
        }

        /// <summary>The stream is a new one of the server's, whose clock is at 0. What plays once is not begun again.</summary>
        void Begin(List<string> over)
        {
            if (hasBlock)
            {
                var awayS = Math.Max(0, sinceBlock.Elapsed.TotalSeconds - (double)bufferBlocks * blockSize / SampleRate);
                clockOffset = SampleClock + (ulong)(awayS * SampleRate);
            }
            hasBlock = false;
            orders.Clear();
            snapshot = null;
            poseId = 0;
            // Not in the hello: a door that the scene lacks would end the stream.
            foreach (var pair in doors) Order(NafirWire.SetDoor(pair.Key, pair.Value));
            doorsMoved.Clear();
            foreach (var pair in emitters)
            {
                if (pair.Value.Heard && pair.Value.PlaysOnce) over.Add(pair.Key);
            }
            foreach (var id in over) emitters.Remove(id);
            foreach (var pair in emitters)
            {
                Prepare(pair.Value);
                Add(pair.Key, pair.Value);
            }
        }

        void Prepare(Emitter emitter)
        {
            emitter.Heard = false;
            emitter.Sequence = 0;
            if (emitter.Source.Clip == null && SampleRate > 0) emitter.Dry = new NafirPlayback(1, outputRate, SampleRate, LiveTargetS);
        }

        /// <summary>The server hears the emitter from a clock on, and has no samples of it yet.</summary>
        static void Open(Emitter emitter, ulong clock)
        {
            emitter.Heard = true;
            emitter.StartClock = clock;
            emitter.SentFrames = 0;
        }

        void Add(string id, Emitter emitter)
        {
            emitter.Refused = null;
            Order(NafirWire.AddEmitter(id, emitter.Source, clockOffset));
            emitter.Number = orders.Count;
        }

        void Hear(byte[] data, int size)
        {
            lock (gate)
            {
                if (!NafirWire.TryParse(data, size, block)) return;
                if (block.Channels == 2)
                {
                    if (!hasBlock || block.SampleClock != nextClock) playback.Break();
                    playback.Push(block.Samples, block.Frames);
                }
                sinceBlock.Restart();
                counts.Blocks++;
                if ((block.Flags & NafirBlock.Late) != 0) counts.BlocksLate++;
                if (hasBlock && block.SampleClock > nextClock) counts.BlocksSkipped += (long)(block.SampleClock - nextClock) / block.Frames;
                hasBlock = true;
                nextClock = block.SampleClock + (ulong)block.Frames;
                SampleClock = nextClock + clockOffset;
                HeardPoseId = block.PoseId;
                HeardReverberationPoseId = block.ReverberationPoseId;
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

        /// <summary>Says what the server counts: now, or once the stream is resumed. A stream that is yet to begin is told all that is wanted
        /// when it does.</summary>
        void Order(string message)
        {
            if (!welcomed && !CanResume) return;
            orders.Add(message);
            if (welcomed) outgoing.Enqueue(message);
        }

        /// <summary>Says what a lost connection makes idle.</summary>
        void Say(object message)
        {
            if (welcomed && outgoing.Count < MostQueued) outgoing.Enqueue(message);
        }

        /// <summary>Sends what is to be said, and of the poses only the newest, until the connection ends.</summary>
        async Task SendAll(ClientWebSocket socket, CancellationToken end)
        {
            object message; // declared here, as above
            try
            {
                while (!end.IsCancellationRequested)
                {
                    lock (gate) AddWhatIsDue();
                    while (outgoing.TryDequeue(out message)) await Send(socket, message, end).ConfigureAwait(false);
                    if (State == NafirState.Closed)
                    {
                        await socket.CloseOutputAsync(WebSocketCloseStatus.NormalClosure, "", end).ConfigureAwait(false);
                        return;
                    }
                    await Task.Delay(PoseIntervalMs, end).ConfigureAwait(false);
                }
            }
            catch (Exception) when (end.IsCancellationRequested || socket.State != WebSocketState.Open)
            {
                socket.Abort(); // ends the reading too, which says why
            }
        }

        void AddWhatIsDue()
        {
            foreach (var pair in emitters)
            {
                var emitter = pair.Value;
                if (emitter.Refused != null)
                {
                    if (emitter.AskAgainMs > 0 && emitter.Refused.ElapsedMilliseconds > emitter.AskAgainMs) Add(pair.Key, emitter);
                    continue;
                }
                if (!emitter.Moved) continue;
                emitter.Moved = false;
                Say(NafirWire.MoveEmitter(pair.Key, ++poseId, emitter.Source.Pose));
            }
            if (sincePing.ElapsedMilliseconds > PingMs)
            {
                sincePing.Restart();
                Say(NafirWire.Ping(++pingId));
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
