// What one listener of a stream hears. Without a type of Unity's.

using System;
using System.Threading;

namespace Nafir
{
    /// <summary>The sound of one listener on its way from the network to an audio thread. Silent until its first block.</summary>
    public sealed class NafirEars
    {
        readonly float[] stereo = new float[2 * 1024]; // of the audio thread
        NafirPlayback playback;
        int sampleRate;

        /// <summary>The quality level that is heard, of a listener beside the first; null before it is there.</summary>
        public string Level { get; internal set; }

        /// <summary>How often the audio thread found too little to play.</summary>
        public int Underruns => Volatile.Read(ref playback)?.Underruns ?? 0;

        /// <summary>Seconds of sound that wait to be played.</summary>
        public double WaitingS => Volatile.Read(ref playback)?.WaitingS ?? 0;

        /// <summary>Whether a block has come since the stream began; `NextClock` is the clock after the newest.</summary>
        internal bool HasBlock { get; private set; }

        internal ulong NextClock { get; private set; }

        /// <summary>Blocks are of this rate from now on.</summary>
        internal void Open(int streamRate, int outputRate, double targetS)
        {
            if (streamRate == sampleRate) return;
            sampleRate = streamRate;
            Volatile.Write(ref playback, new NafirPlayback(2, streamRate, outputRate, targetS));
        }

        /// <summary>The next block is of another stream, whose clock is at 0.</summary>
        internal void BeginAnew() => HasBlock = false;

        /// <summary>Takes the next block, at the opened rate. Returns how many are missing before it.</summary>
        internal long Take(NafirBlock block)
        {
            if (block.Channels == 2)
            {
                if (!HasBlock || block.SampleClock != NextClock) playback.Break();
                playback.Push(block.Samples, block.Frames);
            }
            var missing = HasBlock && block.SampleClock > NextClock ? (long)(block.SampleClock - NextClock) / block.Frames : 0;
            HasBlock = true;
            NextClock = block.SampleClock + (ulong)block.Frames;
            return missing;
        }

        /// <summary>Adds what is heard to interleaved samples at the output's rate, on one audio thread. Both ears go to the first two
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
    }
}
