// What was said to the server and has to reach it, whatever becomes of the connection. Without a type of Unity's.

using System.Collections.Generic;

namespace Nafir
{
    /// <summary>The messages that a server counts: texts that change the stream and are not poses. They are kept after they were sent, until
    /// the server is known to have handled them, so that a resumed stream gets the others again.</summary>
    sealed class NafirOrders
    {
        const int MostKept = 1024;

        readonly Queue<string> kept = new Queue<string>();

        /// <summary>How many there have been since the stream began.</summary>
        public long Count { get; private set; }

        /// <summary>Appends a message, whose number is then <see cref="Count"/>. Of too many, the oldest is let go of.</summary>
        public void Add(string message)
        {
            kept.Enqueue(message);
            Count++;
            if (kept.Count > MostKept) kept.Dequeue();
        }

        /// <summary>A new stream begins.</summary>
        public void Clear()
        {
            kept.Clear();
            Count = 0;
        }

        /// <summary>The first so many need not be sent again.</summary>
        public void Forget(long handled)
        {
            while (kept.Count > 0 && Count - kept.Count < handled) kept.Dequeue();
        }

        /// <summary>The messages after number `handled`, in their order; null if some of them are gone.</summary>
        public string[] After(long handled)
        {
            if (handled < Count - kept.Count) return null;
            Forget(handled);
            return kept.ToArray();
        }
    }
}
