/* The cost of simulated flights, and its slope along one direction, for LANES flights at a time. */
#include "lanes.h"

/* forcing: (steps, 4). measured: (groups, steps + 1, states, LANES), or (steps + 1, states) if `same`: all shots are
   compared with one flight. weights: (12,). first: (12,). alphas: (groups, 8, LANES). direction: (8,), of the
   slope. costs, slopes: (groups, LANES). */
INLINE void shoot(const int states, const int sloped, const int same, int groups, int steps, int begin, double dt, double gravity,
                  const double *forcing, const double *measured, const double *weights, const double *first,
                  const double *alphas, const double *direction, double *costs, double *slopes)
{
    double factors[COEFFICIENTS];
    scale_coefficients(dt, weights, factors);
    for (int group = 0; group < groups; group++) {
        const Lanes *a = (const Lanes *)alphas + group * PARAMETERS;
        const double *y = measured + (same ? 0 : (long)group * (steps + 1) * states * LANES);
        Lanes s[STATES], t[STATES], c[COEFFICIENTS], f[PARAMETERS], cost, slope;
        EACH_LANE cost[l] = slope[l] = 0.0;
        for (int i = 0; i < states; i++)
            EACH_LANE s[i][l] = first[i], t[i][l] = 0.0;
        for (int k = 0; k <= steps; k++, y += same ? states : states * LANES) {
            if (k >= begin)
                EACH_LANE
                {
                    double sum = 0.0, along = 0.0;
#pragma GCC unroll 12
                    for (int i = 0; i < states; i++) {
                        double error = weights[i] * (s[i][l] - y[same ? i : i * LANES + l]);
                        sum += error * error;
                        if (sloped)
                            along += error * t[i][l];
                    }
                    cost[l] += 0.5 * sum;
                    slope[l] += along;
                }
            if (k == steps)
                break;
            advance(states, dt, gravity, forcing + 4 * k, a, s, sloped ? factors : 0, c, f);
            if (sloped) {
                const double *d = direction;
                advance_tangent(states, 1, 0, factors, c, t);
                EACH_LANE
                {
                    t[0][l] += dt * weights[0] * (d[0] * f[0][l] + d[1] * f[1][l] + d[2] * f[2][l]);
                    t[1][l] += dt * weights[1] * (d[3] * f[3][l] + d[4] * f[4][l] + d[5] * f[5][l]);
                    t[2][l] += dt * weights[2] * (d[6] * f[6][l] + d[7] * f[7][l]);
                }
            }
        }
        EACH_LANE costs[group * LANES + l] = cost[l], slopes[group * LANES + l] = slope[l];
    }
}

#define SHOTS(name, ...)                                                                                               \
    void name(int groups, int steps, int begin, double dt, double gravity, const double *forcing,                      \
              const double *measured, const double *weights, const double *first, const double *alphas,                \
              const double *direction, double *costs, double *slopes)                                                  \
    {                                                                                                                  \
        shoot(__VA_ARGS__, groups, steps, begin, dt, gravity, forcing, measured, weights, first, alphas, direction,    \
              costs, slopes);                                                                                          \
    }
SHOTS(shots_all, STATES, 0, 0)
SHOTS(slopes_all, STATES, 1, 0)
SHOTS(shots_rates, RATES, 0, 0)
SHOTS(slopes_rates, RATES, 1, 0)
SHOTS(shots_all_same, STATES, 0, 1)
SHOTS(slopes_all_same, STATES, 1, 1)
SHOTS(shots_rates_same, RATES, 0, 1)
SHOTS(slopes_rates_same, RATES, 1, 1)
