namespace Nafir
{
    /// <summary>What became of a stream so far. Counts run over all its connections.</summary>
    public struct NafirStatistics
    {
        /// <summary>Blocks that arrived, were late by the server's clock, and were left out by it or lost with a connection.</summary>
        public long Blocks, BlocksLate, BlocksSkipped;

        /// <summary>How often the audio thread found too little to play.</summary>
        public int Underruns;

        /// <summary>Connections after the first, and how many of them went on with the stream of the last one.</summary>
        public int Reconnections, Resumptions;

        /// <summary>Seconds from a ping to its answer, and of sound that waits to be played.</summary>
        public double RoundTripS, WaitingS;
    }
}
