// Drives client_examples/unity/Nafir for test_unity.py: a command a line on standard input or one as arguments, an answer a line
// on standard output.

using System;
using System.Collections;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Reflection;
using System.Threading;
using Nafir;
using UnityEngine;

static class UnityDriver
{
    static void Main(string[] given)
    {
        CultureInfo.DefaultThreadCurrentCulture = CultureInfo.CurrentCulture = new CultureInfo("de-DE"); // which writes 1,5
        if (given.Length > 0) Console.WriteLine(Answer(given[0], string.Join(" ", given.Skip(1))));
        for (string line; given.Length == 0 && (line = Console.ReadLine()) != null;)
        {
            var words = line.Split(new[] { ' ' }, 2);
            var rest = words.Length > 1 ? words[1] : "";
            Console.WriteLine(Answer(words[0], rest));
        }
    }

    static string Answer(string command, string rest)
    {
        var words = rest.Split(' ');
        switch (command)
        {
            case "pose": return Converted(Pose(words, 0));
            case "listener": return Hex(NafirWire.Listener(uint.Parse(words[0]), Pose(words, 1)));
            case "number": return Hex(NafirWire.Listener(7, Pose(words, 1), byte.Parse(words[0])));
            case "dry":
                var samples = words.Skip(2).Select(Number).ToArray();
                return Hex(NafirWire.DryBlock(words[0], uint.Parse(words[1]), samples, samples.Length));
            case "block":
                var bytes = Enumerable.Range(0, rest.Length / 2).Select(i => Convert.ToByte(rest.Substring(2 * i, 2), 16)).ToArray();
                var block = new NafirBlock { Samples = new float[1] };
                if (!NafirWire.TryParse(bytes, bytes.Length, block)) return "none";
                var read = block.Samples.Take(block.Channels * block.Frames).Select(each => Text(each));
                return $"{block.Sequence} {block.SampleClock} {block.PoseId} {block.ReverberationPoseId} {block.Flags} {block.Channels} {string.Join(" ", read)}";
            case "texts":
                var pose = new NafirPose(new NafirVector(1.5f, -2.25f, 0.1f), new NafirQuaternion(0, 0, 0.6f, 0.8f));
                return string.Join("\t", new[]
                {
                    NafirWire.Hello("flat \"1\"", 24000, 256, 4, pose), NafirWire.Hello("flat", 0, 512, 8, pose),
                    NafirWire.AddEmitter("a\\b\n", new NafirSource { Clip = "trumpet", Pose = pose, GainDb = -3.5f, Loop = false }),
                    NafirWire.AddEmitter("npc-ä", new NafirSource { Pose = pose }),
                    NafirWire.MoveEmitter("x", uint.MaxValue, pose), NafirWire.SetGain("x", -6), NafirWire.RemoveEmitter("x"),
                    NafirWire.Acknowledge(uint.MaxValue),
                    NafirWire.Resume("a\"b", null, null), NafirWire.Resume(null, "c2ln", new NafirBlock { Sequence = 7, SampleClock = 1UL << 40 }),
                    NafirWire.AddEmitter("shot", new NafirSource { Clip = "trumpet", Pose = pose, Loop = false, StartAt = 5000, StopAt = 100, OffsetS = 0.5f, RemoveWhenEnded = true }, 1000),
                    NafirWire.AddEmitter("loop", new NafirSource { Clip = "trumpet", Pose = pose, LoopStartS = 0.25f, LoopEndS = 1.5f }),
                    NafirWire.AddEmitter("voice", new NafirSource { Pose = pose, JitterMs = 40 }),
                    NafirWire.StopEmitter("x", 5000, 0.5f, 1000), NafirWire.StopEmitter("x", null, 0.01f), NafirWire.SetGain("x", -6, 2.5f),
                    NafirWire.SetLevel("auto"), NafirWire.Ping(9), NafirWire.Hello("flat", 0, 512, 8, pose, "fine"),
                    NafirWire.SetDoor("north \"1\"", 0.25f),
                    NafirWire.Hello("flat", 0, 512, 8, pose, null, 3), NafirWire.AddListener("p\"2", pose, "kemar"), NafirWire.AddListener("p3", pose, null),
                    NafirWire.RemoveListener("p3"), NafirWire.Acknowledge(7, "p\"2"),
                });
            case "json":
                try
                {
                    return Written(NafirJson.ParseObject(rest));
                }
                catch (FormatException)
                {
                    return "refused";
                }
            case "play": return Play(words.Select(each => (double)Number(each)).ToArray());
            case "hear": return Hear(words[0], words[1], words[2], Number(words[3]), words[4], Number(words[5]), words.Length > 6 ? words[6] : null);
            case "cameras": return Cameras(words[0], words[1], words[2]);
            case "listeners": return Listeners(words[0], words[1], words[2]);
            case "doors": return Doors(words[0], words[1]);
            case "shots": return Shots(words[0], words[1], words[2]);
            case "ending": return Ending(words[0], words[1], words[2]);
            case "microphone": return FromMicrophone(words[0], words[1]);
            case "components": return Components(words[0], words[1]);
            default: throw new ArgumentException(command);
        }
    }

    static string Converted(NafirPose unity)
    {
        var pose = NafirPose.FromUnity(unity.Position, unity.Orientation);
        pose.ToUnity(out var position, out var rotation);
        return $"{Text(pose)} {Text(new NafirPose(position, rotation))}";
    }

    // As Play in unreal_driver.cpp.
    static string Play(double[] given)
    {
        double streamRate = given[0], outputRate = given[1], skew = given[2], hertz = given[3], seconds = given[4], fromS = given[5], toS = given[6];
        var playback = new NafirPlayback(2, streamRate, outputRate, 0.06);
        float[] block = new float[2 * 256], output = new float[2 * 512];
        var heard = new List<string>();
        long sent = 0;
        for (double nowS = 0; nowS < seconds; nowS += 512 / outputRate)
        {
            for (;;)
            {
                var dueS = (sent + 256) / streamRate / (1 + skew);
                if (dueS >= fromS && dueS < toS) dueS = toS;
                if (dueS > nowS) break;
                for (int i = 0; i < 256; i++) block[2 * i + 1] = (float)(0.5 * Math.Sin(2 * Math.PI * hertz * (sent + i) / streamRate));
                if (!playback.Push(block, 256)) throw new InvalidOperationException("no room");
                sent += 256;
            }
            playback.Read(output, 512);
            for (int i = 0; i < 512; i++) heard.Add(output[2 * i + 1].ToString("f6", CultureInfo.InvariantCulture));
        }
        return $"{playback.Underruns} {string.Join(" ", heard)}";
    }

    // A game of two objects: a camera that hears, and a thing whose AudioSource plays a tone. Answers with what the camera's audio thread
    // got in three seconds, the tone that is left of the AudioSource, and what is heard a second after the thing was disabled.
    static string Components(string url, string scene)
    {
        var origin = new Transform { position = new Vector3(100, 0, -50), rotation = new Quaternion(0, 0.70710678f, 0, 0.70710678f) };
        var camera = new NafirClient { url = url, scene = scene, origin = origin };
        camera.transform.position = origin.position - new Vector3(-2.5f, -1.5f, 2); // 2 m east of the scene's origin and 2.5 m north
        camera.transform.rotation = origin.rotation;
        var thing = new NafirEmitter { client = camera };
        thing.transform.position = origin.position - new Vector3(-3, -1.5f, 6);
        Call(camera, "OnEnable");
        Call(thing, "OnEnable");
        float[] heard = new float[2 * 480], dry = new float[2 * 480];
        double loudest = 0, left = 0, after = 0;
        var clock = Stopwatch.StartNew();
        for (int quantum = 0; quantum < 500; quantum++)
        {
            var earlyMs = 10.0 * quantum - clock.Elapsed.TotalMilliseconds;
            if (earlyMs > 0) Thread.Sleep((int)Math.Ceiling(earlyMs));
            Call(camera, "Update");
            if (quantum < 300)
            {
                Call(thing, "Update");
                for (int i = 0; i < 480; i++) dry[2 * i] = dry[2 * i + 1] = (float)(0.5 * Math.Sin(2 * Math.PI * 300 * (480 * quantum + i) / 48000));
                Call(thing, "OnAudioFilterRead", dry, 2);
                left = Math.Max(left, dry.Max(each => Math.Abs(each)));
            }
            else if (quantum == 300)
            {
                Call(thing, "OnDisable");
            }
            Array.Clear(heard, 0, heard.Length);
            Call(camera, "OnAudioFilterRead", heard, 2);
            var rms = Math.Sqrt(heard.Sum(each => each * each) / heard.Length);
            if (quantum < 300) loudest = Math.Max(loudest, rms);
            else if (quantum >= 450) after = Math.Max(after, rms);
        }
        var pose = camera.PoseOf(camera.transform);
        var state = camera.Stream.State;
        Call(camera, "OnDisable");
        return $"{state} {Text((float)loudest)} {Text((float)left)} {Text((float)after)} {Text(pose)}";
    }

    // Plays a stream as a sound card would, for some seconds, and writes what is heard (float32, stereo, 48 kHz) to a file. Says meanwhile
    // what becomes of it, a line for each event, and how many samples had been heard by then. While
    // the connection is lost, it adds an emitter. If there is a `shot`, a clip, it is played once by three emitters as soon as there is a
    // snapshot, and the other clip is next to silent: `over` and `stays` play its end, and the first of them is removed then; `heard` plays
    // all of it.
    static string Hear(string url, string scene, string clip, double seconds, string path, double giveUpAfterS, string shot)
    {
        const int Quantum = 480;
        var pose = NafirPose.FromUnity(new NafirVector(2, 1.5f, 2.5f), new NafirQuaternion(0, 0.70710678f, 0, 0.70710678f));
        var source = new NafirSource { Clip = clip, Pose = NafirPose.FromUnity(new NafirVector(6, 1.5f, 3), new NafirQuaternion(0, 0, 0, 1)) };
        using (var stream = new NafirStream(url, scene, 48000, pose, giveUpAfterS: giveUpAfterS))
        using (var file = new BinaryWriter(File.Create(path)))
        {
            int played = 0;
            stream.StateChanged += state =>
            {
                Console.WriteLine($"state {state} {Volatile.Read(ref played)} {stream.Problem}");
                if (state == NafirState.Waiting) stream.SetEmitter("late", new NafirSource { Clip = clip, Pose = pose, GainDb = -70 });
            };
            stream.Received += message =>
            {
                Say(message);
                if (shot == null || (string)message["type"] != "snapshot") return;
                stream.SetEmitter("over", new NafirSource { Clip = shot, Pose = pose, Loop = false, OffsetS = 5, RemoveWhenEnded = true });
                stream.SetEmitter("stays", new NafirSource { Clip = shot, Pose = pose, Loop = false, OffsetS = 5 });
                stream.SetEmitter("heard", new NafirSource { Clip = shot, Pose = pose, Loop = false });
                shot = null;
            };
            stream.EmitterEnded += id => Console.WriteLine($"ended {id}");
            if (shot != null) source.GainDb = -70;
            stream.SetEmitter("source", source);
            var ears = new float[2 * Quantum];
            double fullest = 0;
            var clock = Stopwatch.StartNew();
            for (int quantum = 0; quantum * Quantum < seconds * 48000; quantum++)
            {
                var earlyMs = 1000.0 * quantum * Quantum / 48000 - clock.Elapsed.TotalMilliseconds;
                if (earlyMs > 0) Thread.Sleep((int)Math.Ceiling(earlyMs));
                Array.Clear(ears, 0, ears.Length);
                stream.AddTo(ears, 2);
                foreach (var each in ears) file.Write(each);
                Volatile.Write(ref played, (quantum + 1) * Quantum);
                if (quantum * Quantum > (seconds - 1) * 48000) fullest = Math.Max(fullest, stream.Statistics.WaitingS);
                if (stream.State == NafirState.Lost || stream.State == NafirState.Refused) break;
            }
            var counts = stream.Statistics;
            return Invariant($"end {stream.State} {counts.Reconnections} {counts.Resumptions} {counts.Underruns} {fullest:f3} {counts.RoundTripS:f4} {stream.SampleClock} {stream.Level}");
        }
    }

    static void Say(Dictionary<string, object> message)
    {
        var type = (string)message["type"];
        if (type != "status" && type != "level_changed" && type != "pong" && type != "plan_changed" && type != "snapshot") Console.WriteLine($"{type} {(type == "error" ? message["code"] : type == "welcome" ? "" : message["id"])}");
    }

    static string Invariant(FormattableString text) => FormattableString.Invariant(text);

    // A player, a guest near the clip, and one with a head that there is not. Says who came and went and what became of the stream, plays until
    // it was lost and is live again, and says how loud player and guest were in half a second: before the loss, after it, after the guest was
    // moved to the player, and after it left. Each time it waits until that is as it should be, thirty seconds at most.
    static string Listeners(string url, string scene, string clip)
    {
        const double Heard = 1e-3;
        Func<float, NafirPose> At = x => NafirPose.FromUnity(new NafirVector(x, 1.5f, 2.5f), new NafirQuaternion(0, 0.70710678f, 0, 0.70710678f));
        int joined = 0, refused = 0, lost = 0, again = 0;
        using (var stream = new NafirStream(url, scene, 48000, At(1), listeners: 2))
        {
            stream.ListenerAdded += id =>
            {
                Console.WriteLine($"joined {id}");
                Interlocked.Increment(ref joined);
            };
            stream.ListenerRefused += (id, problem) =>
            {
                Console.WriteLine($"refused {id} {problem.Split(':')[0]}");
                Interlocked.Increment(ref refused);
            };
            stream.StateChanged += state =>
            {
                Console.WriteLine($"state {state}");
                if (state == NafirState.Waiting) Interlocked.Increment(ref lost);
                if (state == NafirState.Live && lost > 0) Interlocked.Increment(ref again);
            };
            var guest = stream.AddListener("guest", At(4.5f));
            stream.AddListener("nobody", At(3), "no such head");
            stream.SetEmitter("source", new NafirSource { Clip = clip, Pose = At(5) });
            var clock = Stopwatch.StartNew();
            long played = 0;
            var mine = new float[2 * 480];
            var theirs = new float[2 * 480];
            // Plays until something has happened, or for so many hundredths of a second. Returns the levels of player and guest.
            Func<int, Func<bool>, double[]> Play = (longest, hasHappened) =>
            {
                double own = 0, other = 0;
                var count = 0;
                for (; count < longest && !hasHappened(); count++)
                {
                    var earlyMs = 10.0 * played++ - clock.Elapsed.TotalMilliseconds;
                    if (earlyMs > 0) Thread.Sleep((int)Math.Ceiling(earlyMs));
                    Array.Clear(mine, 0, mine.Length);
                    Array.Clear(theirs, 0, theirs.Length);
                    stream.AddTo(mine, 2);
                    guest.AddTo(theirs, 2);
                    own += mine.Sum(each => each * each);
                    other += theirs.Sum(each => each * each);
                }
                return new[] { Math.Sqrt(own / (count * mine.Length)), Math.Sqrt(other / (count * mine.Length)) };
            };
            var levels = "";
            Action<Func<double, double, bool>> Await = isSo =>
            {
                double[] found = null;
                for (int tries = 0; tries < 60; tries++)
                {
                    found = Play(50, () => false);
                    if (found[0] > Heard && isSo(found[0], found[1])) break;
                }
                levels += Invariant($" {found[0]} {found[1]}");
            };
            Play(3000, () => Volatile.Read(ref joined) > 0 && Volatile.Read(ref refused) > 0);
            Await((own, other) => other > 2 * own);
            Console.WriteLine("heard");
            Play(3000, () => Volatile.Read(ref again) > 0);
            Play(25, () => false); // what waited to be played
            Await((own, other) => other > 2 * own);
            stream.MoveListener("guest", At(1));
            Await((own, other) => Math.Abs(other / own - 1) < 0.2);
            stream.RemoveListener("guest");
            Await((own, other) => other == 0);
            var counts = stream.Statistics;
            return $"end {stream.State} {counts.Reconnections} {counts.Resumptions}{levels}";
        }
    }

    // Two cameras, the second near a clip. Answers with how loud each was in the second after both were heard, and the second camera after it
    // was disabled.
    static string Cameras(string url, string scene, string clip)
    {
        var camera = new NafirClient { url = url, scene = scene };
        var second = new NafirListener { client = camera };
        var thing = new NafirEmitter { client = camera, clip = clip };
        camera.transform.position = new Vector3(1, 1.5f, 2.5f);
        second.transform.position = new Vector3(4.5f, 1.5f, 2.5f);
        thing.transform.position = new Vector3(5, 1.5f, 2.5f);
        foreach (var each in new object[] { camera, thing }) Call(each, "OnEnable");
        var heard = new float[2 * 480];
        var sums = new double[3];
        Func<object, double> Energy = of =>
        {
            Array.Clear(heard, 0, heard.Length);
            Call(of, "OnAudioFilterRead", heard, 2);
            return heard.Sum(each => each * each);
        };
        var clock = Stopwatch.StartNew();
        var heardAt = 3000; // the quantum since which both are
        for (int quantum = 0; quantum < heardAt + 200; quantum++)
        {
            var earlyMs = 10.0 * quantum - clock.Elapsed.TotalMilliseconds;
            if (earlyMs > 0) Thread.Sleep((int)Math.Ceiling(earlyMs));
            if (quantum == heardAt + 100) Call(second, "OnDisable");
            foreach (var each in new object[] { camera, thing }) Call(each, "Update");
            if (quantum < heardAt + 100) Call(second, "Update");
            double own = Energy(camera), other = Energy(second);
            if (own > 0 && other > 0) heardAt = Math.Min(heardAt, quantum);
            if (quantum >= heardAt && quantum < heardAt + 100)
            {
                sums[0] += own;
                sums[1] += other;
            }
            if (quantum >= heardAt + 150) sums[2] += other;
        }
        foreach (var each in new object[] { thing, camera }) Call(each, "OnDisable");
        return string.Join(" ", sums.Select(each => Text((float)Math.Sqrt(each / (100 * heard.Length)))));
    }

    // Shuts a door before there is a stream and opens it twice the same while there is one, then wants a door that the scene lacks. Answers
    // with how many more messages the server counts for that, its refusals, and whether the stream is live still.
    static string Doors(string url, string scene)
    {
        var pose = NafirPose.FromUnity(new NafirVector(2, 1.5f, 2.5f), new NafirQuaternion(0, 0, 0, 1));
        var refused = new ConcurrentQueue<object>();
        using (var stream = new NafirStream(url, scene, 48000, pose))
        {
            stream.Received += message =>
            {
                if ((string)message["type"] == "error") refused.Enqueue(message["code"]);
            };
            stream.SetDoor("between", 0);
            while (stream.SampleClock == 0) Thread.Sleep(10);
            stream.SetDoor("between", 0.5f);
            stream.SetDoor("between", 0.5f);
            stream.SetDoor("attic", 1);
            for (int i = 0; i < 500 && refused.IsEmpty; i++) Thread.Sleep(10);
            var orders = (NafirOrders)typeof(NafirStream).GetField("orders", BindingFlags.Instance | BindingFlags.NonPublic).GetValue(stream);
            return $"{orders.Count} {string.Join(",", refused)} {stream.State}";
        }
    }

    // Ten one-shots of a clip half a second apart, by the clock. Answers with how many ended, and what was refused.
    static string Shots(string url, string scene, string clip)
    {
        var pose = NafirPose.FromUnity(new NafirVector(2, 1.5f, 2.5f), new NafirQuaternion(0, 0, 0, 1));
        var ended = new ConcurrentQueue<string>();
        var refused = new ConcurrentQueue<string>();
        using (var stream = new NafirStream(url, scene, 48000, pose))
        {
            stream.EmitterEnded += ended.Enqueue;
            stream.EmitterRefused += (id, problem) => refused.Enqueue(problem.Split(':')[0]);
            while (stream.SampleClock == 0) Thread.Sleep(10);
            stream.SetEmitter("nothing", new NafirSource { Clip = "no such clip", Pose = pose });
            var wanted = new List<string>();
            for (int i = 0; i < 5; i++) wanted.Add(stream.PlayOneShot(clip, pose, -6, stream.SampleClock + (ulong)(i * stream.SampleRate / 10)));
            stream.SetEmitter("long", new NafirSource { Clip = clip, Pose = pose });
            stream.SetGain("long", -12, 0.2f);
            Thread.Sleep(500);
            foreach (var id in wanted) stream.StopEmitter(id);
            stream.StopEmitter("long", stream.SampleClock + 4800, 0.05f);
            for (int i = 0; i < 800 && ended.Count < 6; i++) Thread.Sleep(10);
            return $"{ended.Count} {string.Join(",", wanted.Except(ended))} {string.Join(",", refused)}";
        }
    }

    // A thing whose script runs before the camera's plays a clip that ends. Answers with whether it has ended, and the emitters there are then.
    static string Ending(string url, string scene, string clip)
    {
        var camera = new NafirClient { url = url, scene = scene };
        camera.transform.position = new Vector3(2, 1.5f, 2.5f);
        var thing = new NafirEmitter { client = camera, clip = clip, loop = false };
        thing.transform.position = new Vector3(3, 1.5f, 3);
        var hasEnded = false;
        thing.Ended += () => hasEnded = true;
        Call(camera, "OnEnable");
        Call(thing, "OnEnable");
        for (int frame = 0; frame < 1200 && !hasEnded; frame++)
        {
            Thread.Sleep(10);
            Call(thing, "Update");
            if (frame == 60) thing.Stop();
            if (frame % 20 == 0) Call(camera, "Update"); // seldom: the thing's script runs between the end and the news of it
        }
        var emitters = (ICollection)typeof(NafirStream).GetField("emitters", BindingFlags.Instance | BindingFlags.NonPublic).GetValue(camera.Stream);
        var there = emitters.Count;
        foreach (var each in new object[] { thing, camera }) Call(each, "OnDisable");
        return $"{hasEnded} {there}";
    }

    // A game whose microphone hears a tone. Answers with the loudest that comes back in three seconds.
    static string FromMicrophone(string url, string scene)
    {
        var camera = new NafirClient { url = url, scene = scene };
        camera.transform.position = new Vector3(2, 1.5f, 2.5f);
        var thing = new NafirEmitter { client = camera };
        thing.transform.position = new Vector3(3, 1.5f, 3);
        var microphone = new NafirMicrophone { beside = thing };
        foreach (var each in new object[] { camera, thing, microphone }) Call(each, "OnEnable");
        var heard = new float[2 * 480];
        double loudest = 0;
        var clock = Stopwatch.StartNew();
        for (int quantum = 0; quantum < 300; quantum++)
        {
            var earlyMs = 10.0 * quantum - clock.Elapsed.TotalMilliseconds;
            if (earlyMs > 0) Thread.Sleep((int)Math.Ceiling(earlyMs));
            for (int i = 0; i < 480; i++) Microphone.Record((float)(0.5 * Math.Sin(2 * Math.PI * 300 * (480 * quantum + i) / 48000)));
            foreach (var each in new object[] { camera, thing, microphone }) Call(each, "Update");
            Array.Clear(heard, 0, heard.Length);
            Call(camera, "OnAudioFilterRead", heard, 2);
            loudest = Math.Max(loudest, Math.Sqrt(heard.Sum(each => each * each) / heard.Length));
        }
        foreach (var each in new object[] { microphone, thing, camera }) Call(each, "OnDisable");
        return Text((float)loudest);
    }

    static void Call(object of, string method, params object[] arguments) =>
        of.GetType().GetMethod(method, BindingFlags.Instance | BindingFlags.NonPublic).Invoke(of, arguments);

    static string Written(object value)
    {
        if (value is Dictionary<string, object> map) return "{" + string.Join(",", map.Select(each => NafirJson.Quote(each.Key) + ":" + Written(each.Value))) + "}";
        if (value is IList list) return "[" + string.Join(",", list.Cast<object>().Select(Written)) + "]";
        if (value is string text) return NafirJson.Quote(text);
        if (value is double number) return number.ToString("R", CultureInfo.InvariantCulture);
        return value == null ? "null" : (bool)value ? "true" : "false";
    }

    static NafirPose Pose(string[] words, int at)
    {
        var n = words.Skip(at).Take(7).Select(Number).ToArray();
        return new NafirPose(new NafirVector(n[0], n[1], n[2]), new NafirQuaternion(n[3], n[4], n[5], n[6]));
    }

    static string Text(NafirPose pose)
    {
        var p = pose.Position;
        var q = pose.Orientation;
        return string.Join(" ", new[] { p.X, p.Y, p.Z, q.X, q.Y, q.Z, q.W }.Select(each => Text(each)));
    }

    static float Number(string text) => float.Parse(text, CultureInfo.InvariantCulture);

    static string Text(float value) => value.ToString("R", CultureInfo.InvariantCulture);

    static string Hex(byte[] bytes) => BitConverter.ToString(bytes).Replace("-", "").ToLowerInvariant();
}
