# What one listener of a stream hears, on its way from the network to an AudioStreamGenerator. Where the sound has an end (the network
# stalls, blocks are missing, a lost stream goes on elsewhere) it fades out before and in after.
#
# Godot 3 and Godot 4 both read this file: it names nothing that only one of them has, and declares no types.

const FADE_S = 0.005
const MIX_S = 0.012 # what a mixer takes at once
const MOST_S = 0.25 # what is more than this above the target is skipped
const CORRECTION_S = 10.0
const MOST_CORRECTION = 0.002 # three cents
const SMOOTHING_S = 1.0

var sample_rate = 0 # of the blocks; 0 before there are any
var level = "" # that is heard, of a listener beside the first
var next_clock = -1 # of the server, after the newest block of the present stream
var underruns = 0
var waiting_frames = 0

var _target_s = 0.0
var _blocks = [] # of frames, in order
var _first = 0 # frame of the first block that is played next
var _tail = [] # frames of a fade that are still to be played
var _gain = 0.0 # of a fade in
var _room = 0 # frames that an empty generator takes
var _playing = false
var _smooth = 0.0


# Blocks are of this rate from now on. So many seconds of them are held back.
func open(rate, target_s):
	sample_rate = rate
	_target_s = target_s


# Takes the next block, which core.parse_block has read. Returns how many are missing before it.
func take(block):
	var frames = block.frames.size()
	var missing = 0
	if block.sample_clock != next_clock:
		if next_clock >= 0 and frames > 0:
			missing = int((block.sample_clock - next_clock) / frames)
		_end_sound()
	next_clock = block.sample_clock + frames
	_blocks.append(block.frames)
	waiting_frames += frames
	return missing


# Gives an AudioStreamGeneratorPlayback what it takes. Returns the pitch_scale of its player, which makes up for the difference between
# the server's clock and the sound card's. The last frames are kept until others follow, since they fade out if none do.
func play(generator, delta_s):
	if sample_rate == 0:
		return 1.0
	var free = generator.get_frames_available()
	_room = max(_room, free)
	while free > 0 and _tail.size() > 0:
		generator.push_frame(_tail.pop_front())
		free -= 1
	var target = _target_s * sample_rate
	var fade = int(FADE_S * sample_rate)
	var queued = _room - free
	var fill = waiting_frames + queued
	if not _playing:
		if fill < target or _tail.size() > 0:
			return 1.0
		_playing = true
		_smooth = target
		_gain = 0.0
		_skip(fill - target)
	elif waiting_frames <= fade and queued < (delta_s + MIX_S) * sample_rate:
		underruns += 1
		_end_sound()
		return play(generator, delta_s)
	elif queued <= 0 and fill > target: # the game drew too slowly, and nothing was heard meanwhile
		underruns += 1
		_gain = 0.0
		_skip(fill - target)
	elif fill > target + MOST_S * sample_rate:
		_fade_out()
		_skip(fill - target)
		return play(generator, delta_s)
	while free > 0 and waiting_frames > fade:
		if _gain < 1.0:
			generator.push_frame(_take_frame())
			free -= 1
			continue
		var block = _blocks[0]
		var count = int(min(min(free, waiting_frames - fade), block.size() - _first))
		for index in range(_first, _first + count):
			generator.push_frame(block[index])
		free -= count
		_skip(count)
	_smooth += min(1.0, delta_s / SMOOTHING_S) * (fill - _smooth)
	var correction = (_smooth - target) / (CORRECTION_S * sample_rate)
	return 1.0 + max(-MOST_CORRECTION, min(MOST_CORRECTION, correction))


# What waits to be played does not go on: it fades out, and what comes next fades in, once enough of it waits.
func _end_sound():
	if _playing:
		_fade_out()
	_playing = false
	_blocks.clear()
	_first = 0
	waiting_frames = 0


func _fade_out():
	var fade = int(min(FADE_S * sample_rate, waiting_frames))
	for index in range(fade):
		_tail.append(_take_frame() * (1.0 - (index + 1.0) / fade))
	_gain = 0.0


func _take_frame():
	var block = _blocks[0]
	var frame = block[_first]
	_first += 1
	waiting_frames -= 1
	if _first == block.size():
		_blocks.pop_front()
		_first = 0
	if _gain < 1.0:
		_gain = min(1.0, _gain + 1.0 / (FADE_S * sample_rate))
		return frame * _gain
	return frame


func _skip(frames):
	frames = int(max(0, min(frames, waiting_frames)))
	while frames > 0:
		var some = min(frames, _blocks[0].size() - _first)
		_first += some
		waiting_frames -= some
		frames -= some
		if _first == _blocks[0].size():
			_blocks.pop_front()
			_first = 0
