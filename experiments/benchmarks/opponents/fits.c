/* Levenberg-Marquardt with forward sensitivities, for LANES flights at a time: the rates are fitted first, and then all
   channels. A lane whose flight is done takes the next flight. */
#include <stdlib.h>
#include <string.h>

#include "lanes.h"

enum { UNKNOWNS = PARAMETERS + STATES, MOST_SHOTS = 100 };

/* order: of the states in the columns of `measured`: (flights, steps + 1, 12). starts: (flights, 8). half_width: (8,).
   first: (flights, 12). found: (flights, 20), offsets from starts and first in half-widths and standard deviations. */
typedef struct {
    int flights, steps, begin;
    double dt, gravity;
    const int *order;
    const double *forcing, *measured, *weights, *starts, *half_width, *first;
    double *found;
} Data;

/* The search in one lane: `best` is where `cost`, `gradient` and `information` are. */
typedef struct {
    int flight, shots;
    double cost, damping, trial[UNKNOWNS], best[UNKNOWNS], gradient[UNKNOWNS], information[UNKNOWNS][UNKNOWNS];
} Search;

/* Cost, gradient and information (lower triangle) of each lane. `y`: (steps + 1, states, LANES). */
INLINE void linearise(const int states, const int tangents, const Data *data, const Lanes *y, const Lanes *a, Lanes *s,
                      Lanes cost, Lanes *gradient, Lanes *information)
{
    double factors[COEFFICIENTS], added[PARAMETERS];
    Lanes t[states * tangents], e[STATES], c[COEFFICIENTS], f[PARAMETERS];
    static const int row_of[PARAMETERS] = {0, 0, 0, 1, 1, 1, 2, 2};
    scale_coefficients(data->dt, data->weights, factors);
    for (int j = 0; j < PARAMETERS; j++)
        added[j] = data->dt * data->weights[row_of[j]] * data->half_width[j];
    memset(t, 0, sizeof t);
    memset(information, 0, sizeof(Lanes) * tangents * tangents);
    memset(gradient, 0, sizeof(Lanes) * tangents);
    memset(cost, 0, sizeof(Lanes));
    for (int i = 0; i < states && PARAMETERS + i < tangents; i++)
        EACH_LANE t[i * tangents + PARAMETERS + i][l] = 1.0;
    for (int k = 0; k <= data->steps; k++, y += states) {
        if (k >= data->begin) {
            for (int i = 0; i < states; i++)
                EACH_LANE e[i][l] = data->weights[i] * (s[i][l] - y[i][l]), cost[l] += 0.5 * e[i][l] * e[i][l];
            EACH_UNKNOWN(j, 0, tangents)
            {
                EACH_LANE
                {
                    double sum = gradient[j][l];
#pragma GCC unroll 12
                    for (int i = 0; i < states; i++)
                        sum += e[i][l] * t[i * tangents + j][l];
                    gradient[j][l] = sum;
                }
            }
            for (int m = 0; m < tangents; m += 2) /* two rows and two columns at a time share what they load */
                for (int n = 0; n <= m; n += 2)
                    EACH_LANE
                    {
                        double a00 = 0, a01 = 0, a10 = 0, a11 = 0;
#pragma GCC unroll 12
                        for (int i = 0; i < states; i++) {
                            const Lanes *row = t + i * tangents;
                            a00 += row[m][l] * row[n][l], a01 += row[m][l] * row[n + 1][l];
                            a10 += row[m + 1][l] * row[n][l], a11 += row[m + 1][l] * row[n + 1][l];
                        }
                        information[m * tangents + n][l] += a00, information[m * tangents + n + 1][l] += a01;
                        information[(m + 1) * tangents + n][l] += a10, information[(m + 1) * tangents + n + 1][l] += a11;
                    }
        }
        if (k == data->steps)
            break;
        advance(states, data->dt, data->gravity, data->forcing + 4 * k, a, s, factors, c, f);
        EACH_UNKNOWN(j, 0, tangents) advance_tangent(states, tangents, j, factors, c, t);
        for (int j = 0; j < PARAMETERS; j++)
            EACH_LANE t[row_of[j] * tangents + j][l] += added[j] * f[j][l];
    }
}

/* Solves (information + damping diagonal) step = -gradient by Cholesky. Returns by how much the step should lower the
   cost; negative if there is none. */
static double damped_step(const Search *search, int unknowns, double *step)
{
    double factor[UNKNOWNS][UNKNOWNS], gain = 0.0;
    for (int i = 0; i < unknowns; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = search->information[i][j] * (i == j ? 1.0 + search->damping : 1.0);
            for (int k = 0; k < j; k++)
                sum -= factor[i][k] * factor[j][k];
            if (i == j && !(sum > 0.0))
                return -1.0;
            factor[i][j] = i == j ? sqrt(sum) : sum / factor[j][j];
        }
        step[i] = -search->gradient[i];
        for (int k = 0; k < i; k++)
            step[i] -= factor[i][k] * step[k];
        step[i] /= factor[i][i];
        gain += 0.5 * step[i] * step[i];
    }
    for (int i = unknowns - 1; i >= 0; i--) {
        for (int k = i + 1; k < unknowns; k++)
            step[i] -= factor[k][i] * step[k];
        step[i] /= factor[i][i];
    }
    return gain;
}

/* Judges the shot at the trial, and proposes the next one. Returns whether the search is done: its next step promises
   to lower the cost by less than `tolerance`, and is taken unseen. */
static int judge(Search *search, int tangents, int unknowns, double tolerance, int lane, const Lanes cost,
                 const Lanes *gradient, const Lanes *information)
{
    if (cost[lane] < search->cost) {
        search->cost = cost[lane];
        search->damping *= 0.1;
        memcpy(search->best, search->trial, sizeof search->best);
        for (int i = 0; i < unknowns; i++) {
            search->gradient[i] = gradient[i][lane];
            for (int j = 0; j <= i; j++)
                search->information[i][j] = information[i * tangents + j][lane];
        }
    } else
        search->damping = fmax(10.0 * search->damping, 1e-3);
    double step[UNKNOWNS], gain = damped_step(search, unknowns, step);
    for (int i = 0; i < unknowns; i++)
        search->trial[i] = search->best[i] + (gain < 0.0 ? 0.0 : step[i]);
    return gain < tolerance || ++search->shots > MOST_SHOTS;
}

/* Searches from `found`, one stage of all flights. `tangents`: `unknowns`, made even. */
INLINE void stage(const int states, const int unknowns, const Data *data, double tolerance)
{
    const int tangents = unknowns + unknowns % 2, samples = data->steps + 1;
    Lanes *y = calloc((size_t)samples * states, sizeof(Lanes));
    Search *searches = calloc(LANES, sizeof(Search));
    Lanes a[PARAMETERS], s[STATES], cost, gradient[tangents], information[tangents * tangents];
    int next = 0, active = 0;
    for (int l = 0; l < LANES; l++)
        searches[l].flight = -1;
    do {
        for (int l = 0; l < LANES; l++) {
            Search *search = searches + l;
            if (search->flight < 0 && next < data->flights) {
                const double *measured = data->measured + (long)next * samples * STATES;
                for (int k = 0; k < samples; k++)
                    for (int i = 0; i < states; i++)
                        y[k * states + i][l] = measured[k * STATES + data->order[i]];
                *search = (Search){.flight = next++, .cost = INFINITY, .damping = 1e-3};
                memcpy(search->trial, data->found + search->flight * UNKNOWNS, sizeof search->trial);
                active++;
            }
            int flight = search->flight < 0 ? 0 : search->flight;
            for (int j = 0; j < PARAMETERS; j++)
                a[j][l] = data->starts[flight * PARAMETERS + j] + data->half_width[j] * search->trial[j];
            for (int i = 0; i < states; i++)
                s[i][l] = data->first[flight * STATES + i] + search->trial[PARAMETERS + i] / data->weights[i];
        }
        linearise(states, tangents, data, y, a, s, cost, gradient, information);
        for (int l = 0; l < LANES; l++)
            if (searches[l].flight >= 0 &&
                judge(searches + l, tangents, unknowns, tolerance, l, cost, gradient, information)) {
                memcpy(data->found + searches[l].flight * UNKNOWNS, searches[l].trial, unknowns * sizeof(double));
                searches[l].flight = -1;
                active--;
            }
    } while (active > 0 || next < data->flights);
    free(searches);
    free(y);
}

/* Fits all flights. `coarse`: the tolerance of the rates. */
void fits(int known, const Data *data, double coarse, double tolerance)
{
    if (known) {
        stage(RATES, PARAMETERS, data, coarse);
        stage(STATES, PARAMETERS, data, tolerance);
    } else {
        stage(RATES, PARAMETERS + RATES, data, coarse);
        stage(STATES, UNKNOWNS, data, tolerance);
    }
}
