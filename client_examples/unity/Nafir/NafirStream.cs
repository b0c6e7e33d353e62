// A live stream that reconnects by itself, on threads of its own. A server that has kept the stream goes on with it, and is sent what it had
// not got yet. Else the stream begins anew with what is wanted (poses, listeners, emitters, level). Without a type of Unity's.

using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.Diagnostics;
using System.IO;
using System.Linq;
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
        readonly int blockSize, bufferBlocks, outputRate, listeners;
        readonly double targetS, giveUpAfterS;
        readonly CancellationTokenSource ending = new CancellationTokenSource();
        readonly Task running;
        readonly object gate = new object();
        readonly Dictionary<string, float> doors = new Dictionary<string, float>(); // those that the game has moved
        readonly HashSet<string> doorsMoved = new HashSet<string>(); // of them, while there was no connection
        readonly Dictionary<string, Other> others = new Dictionary<string, Other>(); // listeners beside the first
        readonly Dictionary<string, Emitter> emitters = new Dictionary<string, Emitter>();
        readonly ConcurrentQueue<object> outgoing = new ConcurrentQueue<object>(); // string or byte[]
        readonly NafirOrders orders = new NafirOrders();
        readonly NafirBlock block = new NafirBlock();
        readonly NafirBlock newest = new NafirBlock(); // the greatest sequence and clock of all listeners' blocks
        readonly NafirEars ears = new NafirEars(); // of the first listener
        readonly Stopwatch sinceLost = Stopwatch.StartNew(), sinceBlock = Stopwatch.StartNew(), sincePing = Stopwatch.StartNew();
        NafirStatistics counts;
        NafirPose listener;
        bool listenerMoved;
        bool wantsOutputRate = true, welcomed, everWelcomed;
        string wantedLevel; // null is the server's choice
        string token, snapshot; // with which the stream is resumed
        uint poseId, pingId;
        int shots;
        ulong clockOffset; // what is added to the server's clock
        volatile int state = (int)NafirState.Connecting;

        sealed class Emitter
        {
            public NafirSource Source;
            public bool Moved, Stopped;
            public NafirOrder Added; // what adds it
            public NafirPlayback Dry; // of a live one; from the reader of its samples to the stream's rate
            public uint Sequence;
            public bool Heard;
            public ulong StartClock; // of the server
            public bool WasHeard; // when a connection was lost
            public bool HasEnded; // and the game was told so
            public ulong SentFrames;
            public Stopwatch Refused; // since when
            public long AskAgainMs; // after that; 0 for never

            /// <summary>Whether its clip has an end.</summary>
            public bool PlaysOnce => Source.Clip != null && (!Source.Loop || Stopped);

            /// <summary>Whether a server that does not have it is not to begin it again.</summary>
            public bool IsOver => HasEnded || PlaysOnce && WasHeard;

            /// <summary>Whether it is there after so many orders.</summary>
            public bool IsAmong(long handled) => Added == null || Added.Number <= handled;
        }

        sealed class Other
        {
            public readonly NafirEars Ears = new NafirEars();
            public NafirPose Pose;
            public string Head;
            public bool Moved, HasBeen;
            public NafirOrder Added; // what adds it
            public int Number = -1; // in the headers of its blocks; -1 until the server has it
            public Stopwatch Refused; // since when
            public long AskAgainMs; // after that
        }

        /// <summary>`outputRate` is the sound card's. `targetS` is how much sound is held back against a network that stalls. `key` is an API
        /// key or token, if the server asks for one. A server that is gone is tried again for `giveUpAfterS` seconds. It keeps room for so
        /// many `listeners`, the first one included.</summary>
        public NafirStream(string url, string scene, int outputRate, NafirPose listener, double targetS = 0.06, string key = null, int blockSize = 256, int bufferBlocks = 8, double giveUpAfterS = 300, int listeners = 1)
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
            this.listeners = listeners;
            running = Task.Run(Run);
        }

        public NafirState State => (NafirState)state;

        /// <summary>Why the stream was refused or last lost; null if it never was.</summary>
        public string Problem { get; private set; }

        /// <summary>The stream's sample rate; 0 before the first welcome.</summary>
        public int SampleRate { get; private set; }

        /// <summary>The quality level that the first listener hears; null before the first welcome.</summary>
        public string Level { get; private set; }

        /// <summary>The clock of the sample after the newest block, which goes on over lost connections.</summary>
        public ulong SampleClock { get; private set; }

        /// <summary>How often the audio thread of the first listener found too little to play.</summary>
        public int Underruns => ears.Underruns;

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
                    found.WaitingS = ears.WaitingS;
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

        /// <summary>The server has a listener beside the first: also after a connection at whose end the stream began anew.</summary>
        public event Action<string> ListenerAdded;

        /// <summary>The server does not take a listener beside the first, and why. It is forgotten.</summary>
        public event Action<string, string> ListenerRefused;

        public void SetListener(NafirPose pose)
        {
            lock (gate)
            {
                listener = pose;
                listenerMoved = true;
            }
        }

        /// <summary>Adds a listener beside the first, who hears the same emitters: a player at a split screen, or a spectator. Gives the ears
        /// from which an audio thread takes what is heard. `head` is one of the server's; null for its default. One with this id is moved.</summary>
        public NafirEars AddListener(string id, NafirPose pose, string head = null)
        {
            lock (gate)
            {
                if (!others.TryGetValue(id, out var other))
                {
                    others[id] = other = new Other { Pose = pose, Head = head };
                    Ask(id, other);
                }
                other.Pose = pose;
                other.Moved = true;
                return other.Ears;
            }
        }

        /// <summary>Moves a listener beside the first.</summary>
        public void MoveListener(string id, NafirPose pose)
        {
            lock (gate)
            {
                if (!others.TryGetValue(id, out var other)) return;
                other.Pose = pose;
                other.Moved = true;
            }
        }

        public void RemoveListener(string id)
        {
            lock (gate)
            {
                if (others.Remove(id)) Order(NafirWire.RemoveListener(id));
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
                    if (emitter.Source.GainDb != source.GainDb) Order(NafirWire.SetGain(id, source.GainDb), id);
                    emitter.Source = source;
                    emitter.Moved = true;
                    return;
                }
                if (isKnown) Order(NafirWire.RemoveEmitter(id), id);
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
                Order(NafirWire.SetGain(id, gainDb, rampS), id);
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
                Order(NafirWire.StopEmitter(id, stopAt, fadeS, clockOffset), id);
            }
        }

        public void RemoveEmitter(string id)
        {
            lock (gate)
            {
                if (emitters.Remove(id)) Order(NafirWire.RemoveEmitter(id), id);
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

        /// <summary>Adds what the first listener hears to interleaved samples at the output's rate, on the audio thread. Both ears go to the
        /// first two channels; a single one has their mean.</summary>
        public void AddTo(float[] data, int channels) => ears.AddTo(data, channels);

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
                            var isOfStream = !(text.TryGetValue("emitter", out about) && about != null || text.TryGetValue("listener", out about) && about != null);
                            if (text["type"] as string == "error" && isOfStream) lastError = text;
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
                if (CanResume) return NafirWire.Resume(token, snapshot, ears.HasBlock ? newest : null);
                return NafirWire.Hello(scene, wantsOutputRate ? outputRate : 0, blockSize, bufferBlocks, listener, wantedLevel, Math.Max(listeners, 1 + others.Count));
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
            string ended = null, refused = null, entered = null, left = null;
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
                else if (type == "listener_added") entered = Enter(id, (int)(double)message["index"]);
                else if (type == "error" && message.TryGetValue("listener", out name) && name != null) left = Refuse((string)name, message);
                else if (type == "error" && (string)message["code"] == "unknown_message") left = RefuseWhoIsAwaited(message);
                else if (type == "level_changed") LevelChanged(message);
                else if (type == "pong" && (double)message["id"] == pingId) counts.RoundTripS = sincePing.Elapsed.TotalSeconds;
                else if (emitter == null) { }
                else if (type == "emitter_added" && emitter.IsOver)
                {
                    Order(NafirWire.RemoveEmitter(id), id); // the server goes by a snapshot from before it was heard, and begins it again
                    ended = End(id, emitter, true);
                }
                else if (type == "emitter_added") Open(emitter, (ulong)(double)message["sample_clock"]);
                else if (type == "emitter_ended") ended = End(id, emitter, (bool)message["removed"]);
                else if (type == "error" && !emitter.Heard)
                {
                    emitter.Refused = Stopwatch.StartNew();
                    emitter.AskAgainMs = AdviceMs(message);
                    refused = id;
                }
                else if (type == "error" && (string)message["code"] == "unknown_emitter" && emitter.PlaysOnce)
                {
                    ended = End(id, emitter, true); // its end was said just before the connection was lost
                }
            }
            if (type == "error") Problem = $"{message["code"]}: {message["message"]}";
            Received?.Invoke(message);
            if (ended != null) EmitterEnded?.Invoke(ended);
            if (refused != null) EmitterRefused?.Invoke(refused, Problem);
            if (entered != null) ListenerAdded?.Invoke(entered);
            if (left != null) ListenerRefused?.Invoke(left, Problem);
            return type == "welcome";
        }

        void Welcome(Dictionary<string, object> message)
        {
            var over = new List<string>();
            var entered = new List<string>();
            lock (gate)
            {
                welcomed = true;
                int sampleRate = (int)(double)message["sample_rate"];
                token = message.TryGetValue("resume_token", out var given) ? given as string : null;
                Level = (string)message["level"];
                while (outgoing.TryDequeue(out _)) { } // of the last connection
                listenerMoved = true;
                ears.Open(sampleRate, outputRate, targetS);
                SampleRate = sampleRate;
                if (everWelcomed) counts.Reconnections++;
                everWelcomed = true;
                if (message.TryGetValue("resumed", out var resumed) && resumed != null) GoOn((Dictionary<string, object>)resumed, over, entered);
                else Begin(over);
            }
            foreach (var id in over) EmitterEnded?.Invoke(id);
            foreach (var id in entered) ListenerAdded?.Invoke(id);
            Become(NafirState.Live);
        }

        /// <summary>The server has the stream still, or goes by a snapshot of it: it gets what it has not handled, and where everything is
        /// now. What plays once and was heard since the snapshot is not begun again.</summary>
        void GoOn(Dictionary<string, object> resumed, List<string> over, List<string> entered)
        {
            var handled = (long)(double)resumed["handled"];
            var clock = (ulong)(double)resumed["sample_clock"];
            if (!orders.CanResume(handled))
            {
                Forget();
                throw new IOException("too much was said while the connection was lost; the stream begins anew");
            }
            counts.Resumptions++;
            EndWhatIsOver(handled, over);
            foreach (var each in orders.Resume(handled)) outgoing.Enqueue(each);
            foreach (var door in doorsMoved) Order(NafirWire.SetDoor(door, doors[door]));
            doorsMoved.Clear();
            poseId = Math.Max(poseId, (uint)(double)resumed["pose_id"]);
            foreach (var emitter in emitters.Values)
            {
                emitter.Moved = true;
                if (!emitter.IsAmong(handled))
                {
                    emitter.Heard = false; // it is among what is sent again
                }
                else if (emitter.Heard ? emitter.Source.Clip == null : emitter.Refused == null)
                {
                    // That it is heard may have been said just before the connection was lost.
                    var start = emitter.Source.StartAt ?? 0;
                    Open(emitter, Math.Max(clock, start - Math.Min(start, clockOffset)));
                }
            }
            var numbers = new Dictionary<string, int>();
            if (resumed.TryGetValue("listeners", out var listed))
            {
                foreach (Dictionary<string, object> each in (List<object>)listed) numbers[(string)each["id"]] = (int)(double)each["index"];
            }
            foreach (var pair in others)
            {
                var other = pair.Value;
                if (other.Added != null && other.Added.Number > handled) continue; // it is among what is sent again
                if (numbers.TryGetValue(pair.Key, out var number))
                {
                    // That it is there may have been said just before the connection was lost.
                    if (Enter(pair.Key, number) != null) entered.Add(pair.Key);
                }
                else if (other.Number >= 0) other.Number = -1; // an error says why it is gone
                else if (other.Refused == null) Ask(pair.Key, other); // the answer was lost
            }
        }

        /// <summary>The stream is a new one of the server's, whose clock is at 0. What plays once and was heard is not begun again.</summary>
        void Begin(List<string> over)
        {
            EndWhatIsOver(0, over);
            if (ears.HasBlock)
            {
                var awayS = Math.Max(0, sinceBlock.Elapsed.TotalSeconds - (double)bufferBlocks * blockSize / SampleRate);
                clockOffset = SampleClock + (ulong)(awayS * SampleRate);
            }
            ears.BeginAnew();
            newest.Sequence = 0;
            newest.SampleClock = 0;
            orders.Clear();
            snapshot = null;
            poseId = 0;
            // Not in the hello: a door that the scene lacks would end the stream.
            foreach (var pair in doors) Order(NafirWire.SetDoor(pair.Key, pair.Value));
            doorsMoved.Clear();
            foreach (var pair in others) // before what they are to hear from its beginning
            {
                pair.Value.Number = -1;
                pair.Value.Ears.BeginAnew();
                Ask(pair.Key, pair.Value);
            }
            foreach (var pair in emitters)
            {
                Prepare(pair.Value);
                Add(pair.Key, pair.Value);
            }
        }

        /// <summary>A connection was lost, and the server of the next one lacks what was ordered after number `handled`. Emitters among that
        /// which play once, and have ended or were heard, end here.</summary>
        void EndWhatIsOver(long handled, List<string> over)
        {
            foreach (var pair in emitters.ToArray())
            {
                var emitter = pair.Value;
                emitter.WasHeard |= emitter.Heard && ears.HasBlock && emitter.StartClock < ears.NextClock;
                if (!emitter.IsOver || emitter.IsAmong(handled)) continue;
                if (End(pair.Key, emitter, true) != null) over.Add(pair.Key);
            }
        }

        /// <summary>The clip of an emitter is over. The server does not have the emitter any more if it `isGone`. Returns its id if the game is to
        /// be told.</summary>
        string End(string id, Emitter emitter, bool isGone)
        {
            var isNews = !emitter.HasEnded;
            emitter.HasEnded = true;
            if (isGone)
            {
                emitters.Remove(id);
                orders.End(emitter.Added);
            }
            return isNews ? id : null;
        }

        void Prepare(Emitter emitter)
        {
            emitter.Heard = emitter.WasHeard = false;
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
            emitter.Added = Order(NafirWire.AddEmitter(id, emitter.Source, clockOffset), id);
        }

        void Ask(string id, Other other)
        {
            other.Refused = null;
            other.Added = Order(NafirWire.AddListener(id, other.Pose, other.Head));
        }

        /// <summary>The server has a listener beside the first, under this number. Returns its id if that is news.</summary>
        string Enter(string id, int number)
        {
            if (!others.TryGetValue(id, out var other)) return null; // removed meanwhile
            var isNew = other.Number < 0;
            other.Number = number;
            other.HasBeen = other.Moved = true;
            other.Ears.Level = Level;
            other.Ears.Open(SampleRate, outputRate, targetS);
            return isNew ? id : null;
        }

        /// <summary>Takes an error about a listener. One who comes back with a new connection is asked for again when the server says; any
        /// other is forgotten, and its id returned.</summary>
        string Refuse(string id, Dictionary<string, object> error)
        {
            if (!others.TryGetValue(id, out var other) || other.Number >= 0 || (string)error["code"] == "unknown_listener") return null;
            other.AskAgainMs = AdviceMs(error);
            if (other.HasBeen && other.AskAgainMs > 0)
            {
                other.Refused = Stopwatch.StartNew();
                return null;
            }
            others.Remove(id);
            return id;
        }

        /// <summary>As <see cref="Refuse"/>, of a server that is too old to know what was asked, and so does not say about whom it speaks. Had
        /// it not known another message, it would have the listener, who is removed for that.</summary>
        string RefuseWhoIsAwaited(Dictionary<string, object> error)
        {
            foreach (var pair in others)
            {
                if (pair.Value.Number >= 0 || pair.Value.Refused != null) continue;
                var id = Refuse(pair.Key, error);
                if (id != null) Order(NafirWire.RemoveListener(id));
                return id;
            }
            return null;
        }

        void LevelChanged(Dictionary<string, object> message)
        {
            var level = (string)message["level"];
            if (!message.TryGetValue("listener", out var whose) || whose == null) Level = level;
            else if (others.TryGetValue((string)whose, out var other)) other.Ears.Level = level;
        }

        void Hear(byte[] data, int size)
        {
            lock (gate)
            {
                if (!NafirWire.TryParse(data, size, block)) return;
                var id = block.Listener == 0 ? null : IdOf(block.Listener);
                if (block.Listener != 0 && id == null) return; // of one that was removed meanwhile
                newest.Sequence = Math.Max(newest.Sequence, block.Sequence);
                newest.SampleClock = Math.Max(newest.SampleClock, block.SampleClock);
                sinceBlock.Restart();
                counts.Blocks++;
                if ((block.Flags & NafirBlock.Late) != 0) counts.BlocksLate++;
                if (block.Sequence % AcknowledgeEvery == AcknowledgeEvery - 1) Say(NafirWire.Acknowledge(block.Sequence, id));
                counts.BlocksSkipped += (id == null ? ears : others[id].Ears).Take(block);
                if (id != null) return;
                SampleClock = ears.NextClock + clockOffset;
                HeardPoseId = block.PoseId;
                HeardReverberationPoseId = block.ReverberationPoseId;
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

        string IdOf(int number)
        {
            foreach (var pair in others)
            {
                if (pair.Value.Number == number) return pair.Key;
            }
            return null;
        }

        /// <summary>Says what the server counts: now, or once the stream is resumed. A stream that is yet to begin is told all that is wanted
        /// when it does. `emitter` is the id of the one that the message is about. Returns null for what is not said.</summary>
        NafirOrder Order(string message, string emitter = null)
        {
            if (!welcomed && !CanResume) return null;
            if (welcomed) outgoing.Enqueue(message);
            return orders.Add(message, emitter);
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
            foreach (var pair in others)
            {
                var other = pair.Value;
                if (other.Refused != null && other.Refused.ElapsedMilliseconds > other.AskAgainMs) Ask(pair.Key, other);
                if (other.Number < 0 || !other.Moved) continue;
                other.Moved = false;
                Say(NafirWire.Listener(++poseId, other.Pose, (byte)other.Number));
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
