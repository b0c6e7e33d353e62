// Drives client_examples/unity/Nafir for test_unity.py: a command a line on standard input, an answer a line on standard output.

using System;
using System.Collections;
using System.Collections.Generic;
using System.Diagnostics;
using System.Globalization;
using System.Linq;
using System.Reflection;
using System.Threading;
using Nafir;
using UnityEngine;

static class UnityDriver
{
    static void Main()
    {
        CultureInfo.DefaultThreadCurrentCulture = CultureInfo.CurrentCulture = new CultureInfo("de-DE"); // which writes 1,5
        for (string line; (line = Console.ReadLine()) != null;)
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
