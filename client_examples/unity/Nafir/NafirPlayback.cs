// A buffer between the network and the audio thread: one thread pushes, another reads, neither waits and neither allocates.
//
// Where the sound has an end (the network stalls, blocks are missing, a lost stream goes on elsewhere) it fades out before and in after.
// Samples are read at the reader's rate by cubic interpolation. The pace follows the fill by at most 0.2 % (three cents), which makes up
// for the difference between the server's clock and the sound card's.

using System;
using System.Threading;

namespace Nafir
{
    public sealed class NafirPlayback
    {
        const double FadeS = 0.005, Neighbours = 3, CapacityS = 2, MostS = 0.25, SmoothingS = 1, CorrectionS = 10, MostCorrection = 0.002;
        const int MostSeams = 16;

        readonly int channels;
        readonly double writtenRate, step, fade, target;
        readonly float[] ring;
        readonly long capacity;
        readonly long[] seams = new long[MostSeams]; // frames before which the sound was interrupted
        long written, read;
        int seamsWritten, seamsRead, underruns;

        // Of the reading thread alone; positions are frames since the first.
        double at, smooth, gain;
        bool playing, skipping;

        /// <summary>`targetS` is how much is held back: more copes with a worse network, less is heard sooner.</summary>
        public NafirPlayback(int channels, double writtenRate, double readRate, double targetS)
        {
            this.channels = channels;
            this.writtenRate = writtenRate;
            step = writtenRate / readRate;
            fade = FadeS * writtenRate;
            target = Math.Max(2 * fade, targetS * writtenRate);
            capacity = (long)(target + CapacityS * writtenRate);
            ring = new float[capacity * channels];
        }

        /// <summary>How often the reader found too little.</summary>
        public int Underruns => Volatile.Read(ref underruns);

        /// <summary>Seconds of sound that wait.</summary>
        public double WaitingS => Math.Max(0, Volatile.Read(ref written) - Volatile.Read(ref read)) / writtenRate;

        /// <summary>What is pushed next does not continue what was pushed before: fades out and in there, and holds back as much as at the
        /// beginning.</summary>
        public void Break()
        {
            if (seamsWritten - Volatile.Read(ref seamsRead) == MostSeams) return; // a network of nothing but gaps
            seams[seamsWritten % MostSeams] = written;
            Volatile.Write(ref seamsWritten, seamsWritten + 1);
        }

        /// <summary>Takes interleaved frames. Returns false if there is no room, because nobody reads.</summary>
        public bool Push(float[] samples, int frames)
        {
            long first = written;
            if (first - Volatile.Read(ref read) + frames > capacity) return false;
            for (int i = 0; i < frames; i++) Array.Copy(samples, i * channels, ring, (first + i) % capacity * channels, channels);
            Volatile.Write(ref written, first + frames);
            return true;
        }

        /// <summary>Fills interleaved frames; with silence until enough is there.</summary>
        public void Read(float[] output, int frames)
        {
            long end = Volatile.Read(ref written);
            double pace = step * (1 + Correction(end - at, frames));
            for (int i = 0; i < frames; i++)
            {
                if (!playing && end - at >= target) Start(end);
                double seam = Seam();
                double free = Math.Min(end, seam) - at - Neighbours;
                if (!playing || free < pace)
                {
                    if (playing && seam > end) Interlocked.Increment(ref underruns);
                    if (seam <= end) at = seam;
                    playing = false;
                    Array.Clear(output, i * channels, channels);
                    continue;
                }
                // After a stall, too much comes at once: fades out, and goes on with the newest.
                if (end - at > target + MostS * writtenRate) skipping = true;
                gain = skipping ? gain - 1 / fade : Math.Min(Math.Min(gain + 1 / fade, free / fade), 1);
                if (skipping && gain <= 0)
                {
                    Start(end);
                    skipping = false;
                }
                Interpolate(output, i * channels);
                at += pace;
            }
            Volatile.Write(ref read, Math.Max(0, (long)at - 1));
        }

        /// <summary>Where the sound ends next, though more has been written.</summary>
        double Seam()
        {
            int count = Volatile.Read(ref seamsWritten);
            while (seamsRead != count && seams[seamsRead % MostSeams] <= at) Volatile.Write(ref seamsRead, seamsRead + 1);
            return seamsRead != count ? seams[seamsRead % MostSeams] : double.PositiveInfinity;
        }

        void Start(long end)
        {
            at = end - target; // older frames of the same burst would only add delay
            smooth = target;
            gain = 0;
            playing = true;
        }

        double Correction(double fill, int frames)
        {
            if (!playing) return 0;
            smooth += Math.Min(1, frames * step / (SmoothingS * writtenRate)) * (fill - smooth);
            return Math.Max(-MostCorrection, Math.Min(MostCorrection, (smooth - target) / (CorrectionS * writtenRate)));
        }

        void Interpolate(float[] output, int to)
        {
            long now = (long)at;
            float t = (float)(at - now), level = (float)gain;
            long before = (now - 1 + capacity) % capacity * channels, here = now % capacity * channels;
            long next = (now + 1) % capacity * channels, after = (now + 2) % capacity * channels;
            for (int channel = 0; channel < channels; channel++)
            {
                float a = ring[before + channel], b = ring[here + channel], c = ring[next + channel], d = ring[after + channel];
                float slope = (c - a) / 2, nextSlope = (d - b) / 2;
                float curve = 3 * (c - b) - 2 * slope - nextSlope, twist = 2 * (b - c) + slope + nextSlope;
                output[to + channel] = level * (b + t * (slope + t * (curve + t * twist)));
            }
        }
    }
}
