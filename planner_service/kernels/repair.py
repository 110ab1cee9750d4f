"""Mending a tree after weights changed, without growing it anew. Arrays are laid out as `rules` says."""

from __future__ import annotations

import numpy as np
from numba import njit

from planner_service.kernels.rules import INF, NONE, RULE_FOUR, RULE_OCTILE, SQRT2


@njit(cache=True, nogil=True)
def _sink(keys, items, size):
    """Restore a binary heap after its last element, keys[size], was taken from the end to replace the top."""
    key = keys[size]
    item = items[size]
    hole = 0
    while True:
        child = 2 * hole + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[hole] = keys[child]
        items[hole] = items[child]
        hole = child
    keys[hole] = key
    items[hole] = item


@njit(cache=True, nogil=True)
def _rise(keys, items, size, key, item):
    hole = size
    while hole > 0:
        above = (hole - 1) >> 1
        if keys[above] <= key:
            break
        keys[hole] = keys[above]
        items[hole] = items[above]
        hole = above
    keys[hole] = key
    items[hole] = item


@njit(cache=True, nogil=True)
def step_offsets(stride):
    """What each direction code 0..7 adds to a padded cell index."""
    return np.array((-stride, 1 - stride, 1, stride + 1, stride, stride - 1, -1, -stride - 1))


@njit(cache=True, nogil=True)
def _offer(weight, cost, offsets, rule, corners, v):
    """(smallest exit key among the neighbours of v, direction to it)."""
    best = INF
    code = NONE
    for k in (0, 2, 4, 6):
        u = v + offsets[k]
        key = cost[u] + weight[u]
        if key < best:
            best = key
            code = np.uint8(k)
    if rule != RULE_FOUR:
        for k in (1, 3, 5, 7):
            if not corners and not max(weight[v + offsets[k - 1]], weight[v + offsets[(k + 1) & 7]]) < INF:
                continue
            u = v + offsets[k]
            key = cost[u] + (weight[u] * SQRT2 if rule == RULE_OCTILE else weight[u])
            if key < best:
                best = key
                code = np.uint8(k)
    return best, code


@njit(cache=True, nogil=True)
def _wave(weight, cost, offsets, rule, corners, root, candidates, count, limit):
    """Let better offers spread from `candidates` until no cell is offered less than it costs.

    Returns (cells popped, or -1 beyond `limit`; the largest cost popped; the cells whose cost fell, with
    repetitions; how many).
    """
    capacity = 64 + 2 * count
    keys = np.empty(capacity, np.float32)
    items = np.empty(capacity, np.int64)
    fallen = np.empty(capacity, np.int64)
    falls = 0
    size = 0
    for i in range(count):
        v = candidates[i]
        if v == root or not weight[v] < INF:
            continue
        best, _ = _offer(weight, cost, offsets, rule, corners, v)
        if best < cost[v]:
            cost[v] = best
            _rise(keys, items, size, best, v)
            size += 1
            fallen[falls] = v
            falls += 1
    popped = 0
    key = np.float32(0.0)
    while size > 0:
        key = keys[0]
        u = items[0]
        size -= 1
        _sink(keys, items, size)
        if key > cost[u]:
            continue
        popped += 1
        if popped > limit:
            return -1, key, fallen, falls
        if max(size, falls) + 16 > capacity:
            new_keys = np.empty(2 * capacity, np.float32)
            new_items = np.empty(2 * capacity, np.int64)
            new_fallen = np.empty(2 * capacity, np.int64)
            new_keys[:size] = keys[:size]
            new_items[:size] = items[:size]
            new_fallen[:falls] = fallen[:falls]
            keys = new_keys
            items = new_items
            fallen = new_fallen
            capacity *= 2
        straight = key + weight[u]
        diagonal = key + (weight[u] * SQRT2 if rule == RULE_OCTILE else weight[u])
        for k in range(0, 8, 2 if rule == RULE_FOUR else 1):
            v = u + offsets[k]
            offer = diagonal if k & 1 else straight
            if not offer < cost[v] or not weight[v] < INF:
                continue
            shut = max(weight[u + offsets[k - 1]], weight[u + offsets[(k + 1) & 7]]) == INF
            if k & 1 and not corners and shut:
                continue
            cost[v] = offer
            _rise(keys, items, size, offer, v)
            size += 1
            fallen[falls] = v
            falls += 1
    return popped, key, fallen, falls


@njit(cache=True, nogil=True)
def _eased(weight, offsets, changed, before, out, count):
    """Append the cells that may be offered less since the weights of `changed` fell. Returns how many there are."""
    for i in range(changed.size):
        x = changed[i]
        if weight[x] < before[i]:
            out[count] = x
            count += 1
            for k in range(8):
                out[count] = x + offsets[k]
                count += 1
    return count


@njit(cache=True, nogil=True)
def lower(weight, cost, stride, rule, corners, changed, before, limit):
    """After weights fell, let costs fall: no cell costs more than what any neighbour offers, where so before.

    Needs no parents, and no root but a cell that costs least. Returns cells visited, or -1 beyond `limit`; then
    cost is of no use any more.
    """
    offsets = step_offsets(stride)
    candidates = np.empty(9 * changed.size, np.int64)
    count = _eased(weight, offsets, changed, before, candidates, 0)
    popped, _, _, _ = _wave(weight, cost, offsets, rule, corners, -1, candidates, count, limit)
    return popped


@njit(cache=True, nogil=True)
def repair(weight, cost, parent, stride, rule, corners, root, changed, before, limit, state):
    """Bring a tree up to date after the weights of `changed` cells became what they are now.

    changed  int64    padded cells, without repetition; before: float32, their weights when the tree was right
    state    uint8    scratch, zero; zero again afterwards
    Cells whose way led through a dearer cell lose their cost and find a new one; the rest only improves. An exact
    tree is exact afterwards, equal to one grown from scratch. Returns (cells visited, the largest new cost); -1
    cells if more than `limit` are concerned: then the tree is of no use any more and must be grown.
    """
    offsets = step_offsets(stride)
    capacity = 64 + 12 * changed.size
    affected = np.empty(capacity, np.int64)
    count = 0
    for i in range(changed.size):
        x = changed[i]
        if not weight[x] > before[i]:
            continue
        lethal = not weight[x] < INF
        if lethal and state[x] == 0 and x != root:
            state[x] = 1
            affected[count] = x
            count += 1
        for k in range(8):
            v = x + offsets[k]
            way = parent[v]
            if way == NONE or state[v] != 0:
                continue
            squeezed = False
            if lethal and not corners and way & 1:
                squeezed = v + offsets[way - 1] == x or v + offsets[(way + 1) & 7] == x
            if squeezed or way == (k + 4) & 7:
                state[v] = 1
                affected[count] = v
                count += 1
    done = 0
    while done < count and count <= limit:
        u = affected[done]
        done += 1
        if count + 8 > capacity:
            new_affected = np.empty(2 * capacity, np.int64)
            new_affected[:count] = affected[:count]
            affected = new_affected
            capacity *= 2
        for k in range(8):
            v = u + offsets[k]
            if state[v] == 0 and parent[v] == (k + 4) & 7:
                state[v] = 1
                affected[count] = v
                count += 1
    for i in range(count):
        state[affected[i]] = 0
    if count > limit:
        return -1, INF
    for i in range(count):
        cost[affected[i]] = INF
    candidates = np.empty(count + 9 * changed.size, np.int64)
    candidates[:count] = affected[:count]
    total = _eased(weight, offsets, changed, before, candidates, count)
    popped, highest, fallen, falls = _wave(weight, cost, offsets, rule, corners, root, candidates, total, limit)
    if popped < 0:
        return -1, INF
    # Whoever stands beside a cell that changed may have a better neighbour now.
    for part in range(3):
        many = (changed.size, count, falls)[part]
        for i in range(many):
            x = changed[i] if part == 0 else (affected[i] if part == 1 else fallen[i])
            if state[x] == 2:
                continue
            state[x] = 2
            for k in range(-1, 8):
                v = x if k < 0 else x + offsets[k]
                if weight[v] < INF and v != root:
                    _, code = _offer(weight, cost, offsets, rule, corners, v)
                    parent[v] = code if cost[v] < INF else NONE
                elif v != root:
                    parent[v] = NONE
    for i in range(changed.size):
        state[changed[i]] = 0
    for i in range(count):
        state[affected[i]] = 0
    for i in range(falls):
        state[fallen[i]] = 0
    return popped + count, highest
