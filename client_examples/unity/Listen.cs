// Hears a scene without Unity: walks past a clip, or past a live source, and prints the level of both ears ten times a second.
//
//   mono Listen.exe [HOST:PORT [SCENE [CLIP|live [SECONDS [KEY]]]]]

using System;
using System.Globalization;
using System.Threading;
using Nafir;

static class Listen
{
    const int OutputRate = 48000, Frames = 480;

    static int Main(string[] words)
    {
        CultureInfo.DefaultThreadCurrentCulture = CultureInfo.CurrentCulture = CultureInfo.InvariantCulture;
        string address = Word(words, 0, "127.0.0.1:8000"), scene = Word(words, 1, "apartment"), clip = Word(words, 2, "woman-reading");
        double seconds = double.Parse(Word(words, 3, "5"));
        // In the axes of Unity: 2 m to the right of the origin, 1.5 m up, 2.5 m ahead; it looks to the right, which is east.
        var east = new NafirQuaternion(0, 0.70710678f, 0, 0.70710678f);
        Func<double, NafirPose> walk = share => NafirPose.FromUnity(new NafirVector((float)(2 + 2 * share), 1.5f, 2.5f), east);
        var source = new NafirSource { Clip = clip == "live" ? null : clip, Pose = NafirPose.FromUnity(new NafirVector(6, 1.5f, 3), east) };
        using (var stream = new NafirStream($"ws://{address}/v1/stream", scene, OutputRate, walk(0), key: Word(words, 4, null)))
        {
            stream.SetEmitter("source", source);
            var ears = new float[2 * Frames];
            var dry = new float[Frames];
            double left = 0, right = 0;
            int played = 0;
            var clock = System.Diagnostics.Stopwatch.StartNew();
            // A sound card would ask for so many samples at such times.
            for (int quantum = 0; quantum * Frames < seconds * OutputRate; quantum++)
            {
                var earlyMs = 1000.0 * quantum * Frames / OutputRate - clock.Elapsed.TotalMilliseconds;
                if (earlyMs > 0) Thread.Sleep((int)Math.Ceiling(earlyMs));
                if (stream.State == NafirState.Refused)
                {
                    Console.Error.WriteLine(stream.Problem);
                    return 1;
                }
                stream.SetListener(walk(quantum * Frames / (seconds * OutputRate)));
                for (int i = 0; i < Frames; i++) dry[i] = (float)(0.25 * Math.Sin(2 * Math.PI * 440 * (quantum * Frames + i) / OutputRate));
                stream.PushDry("source", dry, Frames);
                Array.Clear(ears, 0, ears.Length);
                stream.AddTo(ears, 2);
                for (int i = 0; i < Frames; i++)
                {
                    left += ears[2 * i] * ears[2 * i];
                    right += ears[2 * i + 1] * ears[2 * i + 1];
                }
                played += Frames;
                if (played < OutputRate / 10) continue;
                Console.WriteLine($"{(quantum + 1) * Frames / (double)OutputRate:f2} s  left {Math.Sqrt(left / played):f5}  right {Math.Sqrt(right / played):f5}  pose {stream.HeardPoseId}  {stream.State}");
                left = right = played = 0;
            }
            if (stream.State == NafirState.Live) return 0;
            Console.Error.WriteLine(stream.Problem);
            return 1;
        }
    }

    static string Word(string[] words, int index, string usual) => words.Length > index ? words[index] : usual;
}
