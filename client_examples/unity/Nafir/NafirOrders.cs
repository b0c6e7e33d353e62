// What was said to the server and has to reach it, whatever becomes of the connection. Without a type of Unity's.

using System.Collections.Generic;
using System.Linq;

namespace Nafir
{
    /// <summary>A message that a server counts: a text that changes the stream and is no pose.</summary>
    sealed class NafirOrder
    {
        public string Text;

        /// <summary>The id of the emitter that it is about; null if it is about none.</summary>
        public string Emitter;

        /// <summary>How many there were with this one since the stream began.</summary>
        public long Number;

        /// <summary>Whether the emitter that it is about has ended, so that it is not sent again.</summary>
        public bool IsOver;
    }

    /// <summary>The orders of a stream. They are kept after they were sent, until the server is known to have handled them, so that a resumed
    /// stream gets the others again.</summary>
    sealed class NafirOrders
    {
        const int MostKept = 1024;

        Queue<NafirOrder> kept = new Queue<NafirOrder>();

        /// <summary>How many there have been since the stream began.</summary>
        public long Count { get; private set; }

        /// <summary>Appends a message. Of too many, the oldest is let go of.</summary>
        public NafirOrder Add(string text, string emitter)
        {
            var order = new NafirOrder { Text = text, Emitter = emitter, Number = ++Count };
            kept.Enqueue(order);
            if (kept.Count > MostKept) kept.Dequeue();
            return order;
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

        /// <summary>The emitter that an order has added is over and gone: if the order is kept still, neither it nor what was said of the emitter
        /// since is sent again.</summary>
        public void End(NafirOrder added)
        {
            if (!kept.Contains(added)) return;
            foreach (var each in kept) each.IsOver |= each.Emitter == added.Emitter && each.Number >= added.Number;
        }

        /// <summary>Whether all after number `handled` are kept.</summary>
        public bool CanResume(long handled) => handled >= Count - kept.Count;

        /// <summary>Returns the messages that a server lacks which has handled so many, in their order. Those that are over are let go of, and the
        /// others have the numbers by which the server is going to count them.</summary>
        public IEnumerable<string> Resume(long handled)
        {
            Forget(handled);
            Count -= kept.Count;
            kept = new Queue<NafirOrder>(kept.Where(each => !each.IsOver));
            foreach (var each in kept) each.Number = ++Count;
            return kept.Select(each => each.Text);
        }
    }
}
